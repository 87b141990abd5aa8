"""Equations of a record's model, with the terms of its structure, as MathML and LaTeX."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Final, NamedTuple

from analysis.identify import BACKGROUND_COEFFICIENTS
from analysis.models import STRUCTURES
from analysis.report.table import ABSENT_TEXT, TEXT_FORMAT, Column, Table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.identify import RecordFit
    from analysis.models import Structure
    from analysis.results import WholeRecord


class Formula(NamedTuple):
    """Mathematical formula as presentation MathML, without its root element, and as LaTeX."""

    mathml: str
    tex: str

    def __add__(self, next_formula: object) -> Formula:
        """Return this formula followed by another one."""
        if not isinstance(next_formula, Formula):
            return NotImplemented
        return Formula(self.mathml + next_formula.mathml, f"{self.tex} {next_formula.tex}")

    @property
    def grouped_formula(self) -> Formula:
        """Formula grouped so that it can be one argument of another formula."""
        return Formula(f"<mrow>{self.mathml}</mrow>", f"{{{self.tex}}}")


def _variable(letter: str, tex_command: str = "") -> Formula:
    """Return a variable, from its letter and its LaTeX command."""
    return Formula(f"<mi>{letter}</mi>", tex_command or letter)


def _operator(operator_text: str, tex_command: str = "") -> Formula:
    """Return an operator or bracket, from its character and its LaTeX command."""
    return Formula(f"<mo>{operator_text}</mo>", tex_command or operator_text)


def _number_formula(number_text: str) -> Formula:
    """Return a number as a formula."""
    return Formula(f"<mn>{number_text}</mn>", number_text)


def _power(base_formula: Formula, exponent_formula: Formula) -> Formula:
    """Return a formula raised to the power of another formula."""
    exponent_group = exponent_formula.grouped_formula
    return Formula(
        f"<msup>{base_formula.grouped_formula.mathml}{exponent_group.mathml}</msup>",
        f"{base_formula.tex}^{exponent_group.tex}",
    )


def _subscript(base_formula: Formula, subscript_formula: Formula) -> Formula:
    """Return a formula with another formula as its subscript."""
    index_group = subscript_formula.grouped_formula
    return Formula(
        f"<msub>{base_formula.grouped_formula.mathml}{index_group.mathml}</msub>",
        f"{base_formula.tex}_{index_group.tex}",
    )


def _fraction(numerator: Formula, denominator: Formula) -> Formula:
    """Return the fraction of two formulas."""
    a, b = numerator.grouped_formula, denominator.grouped_formula
    return Formula(f"<mfrac>{a.mathml}{b.mathml}</mfrac>", rf"\frac{a.tex}{b.tex}")


def _function_formula(function_word: str, argument_formula: Formula) -> Formula:
    """Return a function with several letters, such as sin, of an argument in brackets."""
    function_name = Formula(f"<mi>{function_word}</mi><mo>&#x2061;</mo>", rf"\{function_word}")
    return _join_formulas(function_name, _OPENING_BRACKET, argument_formula, _CLOSING_BRACKET)


def _join_formulas(*joined_formulas: Formula) -> Formula:
    """Return a formula that consists of several formulas, one after the other."""
    return reduce(Formula.__add__, joined_formulas)


_S_SYMBOL: Final = _variable("s")
"""Symbols, signs and numbers of the equations as formulas."""
_L_SYMBOL: Final = _variable("L")
_G_SYMBOL: Final = _variable("G")
_EI_SYMBOLS: Final = _variable("E") + _variable("I")
_BETA_SYMBOL: Final = _variable("β", r"\beta")
_ZETA_SYMBOL, _ALPHA_SYMBOL = _variable("ζ", r"\zeta"), _variable("α", r"\alpha")
_GAMMA_SYMBOL, _LAMBDA_SYMBOL = _variable("γ", r"\gamma"), _variable("λ", r"\lambda")
_PLUS_SIGN, _MINUS_SIGN, _EQUALS_SIGN = _operator("+"), _operator("−", "-"), _operator("=")
_OPENING_BRACKET, _CLOSING_BRACKET = _operator("("), _operator(")")
_NUMBER_ONE, _NUMBER_TWO = _number_formula("1"), _number_formula("2")
_ARGUMENT_S: Final = _OPENING_BRACKET + _S_SYMBOL + _CLOSING_BRACKET
"""Formula "(s)", the argument of transfer functions."""


_TORQUE_OVER_ANGLE: Final = _fraction(
    _subscript(_variable("Γ", r"\Gamma"), Formula("<mtext>coup</mtext>", r"\mathrm{coup}"))
    + _ARGUMENT_S,
    _subscript(_variable("Θ", r"\Theta"), _variable("m")) + _ARGUMENT_S,
)
"""Formula of the coupling torque divided by the motor angle, both as Laplace transforms."""


def _damping_term(
    coefficient_symbol: Formula, order_symbol: Formula, *, is_first_order: bool
) -> Formula:
    """Return the formula of a damping term: coefficient times s or a fractional power of s."""
    return coefficient_symbol + (_S_SYMBOL if is_first_order else _power(_S_SYMBOL, order_symbol))


def _elastic_factor(structure: Structure) -> Formula | None:
    """Return the formula ``1 + zeta s^alpha``, or None for a structure without internal damping."""
    if not structure.has_internal_damping:
        return None
    return _join_formulas(
        _NUMBER_ONE,
        _PLUS_SIGN,
        _damping_term(_ZETA_SYMBOL, _ALPHA_SYMBOL, is_first_order="alpha" not in structure.free),
    )


def _inertial_terms(structure: Structure) -> Formula:
    """Return the formula ``rho/EI s^2 + gamma s^lambda`` with the structure's external damping."""
    density_ratio = _fraction(_variable("ρ", r"\rho"), _EI_SYMBOLS)
    # In display style, although the ratio is inside a fraction.
    ratio_mathml = f'<mstyle displaystyle="true">{density_ratio.mathml}</mstyle>'
    inertia = Formula(ratio_mathml, density_ratio.tex.replace("frac", "dfrac")) + _power(
        _S_SYMBOL, _NUMBER_TWO
    )
    if not structure.has_external_damping:
        return inertia
    return _join_formulas(
        inertia,
        _PLUS_SIGN,
        _damping_term(_GAMMA_SYMBOL, _LAMBDA_SYMBOL, is_first_order="lambda" not in structure.free),
    )


def _beam_equations(structure: Structure) -> tuple[Formula, Formula]:
    """Return the equations of the beam's response and of the wave number beta in the response.

    The first equation is Eq. 25 of the reference paper.
    """
    elastic_factor, z = _elastic_factor(structure), _BETA_SYMBOL + _L_SYMBOL
    sin, cos, sinh, cosh = (
        _function_formula(function_word, z) for function_word in ("sin", "cos", "sinh", "cosh")
    )
    stiffness_factor = (
        _EI_SYMBOLS
        if elastic_factor is None
        else _join_formulas(_EI_SYMBOLS, _OPENING_BRACKET, elastic_factor, _CLOSING_BRACKET)
    )
    numerator = _join_formulas(sin, cosh, _MINUS_SIGN, cos, sinh)
    denominator = _join_formulas(_NUMBER_ONE, _PLUS_SIGN, cos, cosh)
    response_equation = _join_formulas(
        _G_SYMBOL,
        _ARGUMENT_S,
        _EQUALS_SIGN,
        _MINUS_SIGN,
        stiffness_factor,
        _BETA_SYMBOL,
        _fraction(numerator, denominator),
    )
    inertial_terms = _inertial_terms(structure)
    minus_beta_to_4 = (
        (_OPENING_BRACKET + inertial_terms + _CLOSING_BRACKET)
        if elastic_factor is None
        else _fraction(inertial_terms, elastic_factor)
    )
    return response_equation, _join_formulas(
        _power(_BETA_SYMBOL, _number_formula("4")), _EQUALS_SIGN, _MINUS_SIGN, minus_beta_to_4
    )


def _measured_equation(fit: RecordFit) -> Formula:
    """Return the equation of measured torque divided by angle: beam, tool inertia and channels."""
    beam_response = _G_SYMBOL + _ARGUMENT_S
    parameter_names = fit.parameters
    beam_and_tool = _join_formulas(
        beam_response, _PLUS_SIGN, _variable("J"), _power(_S_SYMBOL, _NUMBER_TWO)
    )
    delay_factor = _power(
        _variable("e"), _join_formulas(_MINUS_SIGN, _variable("τ", r"\tau"), _S_SYMBOL)
    )
    measured_formula = _join_formulas(
        _operator("[", r"\left["), beam_and_tool, _operator("]", r"\right]"), delay_factor
    )
    filter_term = _variable("T") + _S_SYMBOL
    if "filter_time_constant_s" in parameter_names:
        measured_formula += _fraction(
            _NUMBER_ONE, _join_formulas(_NUMBER_ONE, _PLUS_SIGN, filter_term)
        )
    if "second_order_filter_time_constant_s" in parameter_names:
        root_two = Formula(f"<msqrt>{_NUMBER_TWO.mathml}</msqrt>", r"\sqrt{2}")
        square_sum = _power(_variable("T"), _NUMBER_TWO) + _power(_S_SYMBOL, _NUMBER_TWO)
        measured_formula += _fraction(
            _NUMBER_ONE,
            _join_formulas(_NUMBER_ONE, _PLUS_SIGN, root_two, filter_term, _PLUS_SIGN, square_sum),
        )
    return _join_formulas(_TORQUE_OVER_ANGLE, _EQUALS_SIGN, measured_formula)


def _modal_equation() -> Formula:
    """Return the equation of the modal model: poles and residues, and background terms."""
    k, n, highest_exponent = _variable("k"), _variable("n"), BACKGROUND_COEFFICIENTS - 1
    sum_over_modes = Formula(
        f"<munder><mo>∑</mo>{k.grouped_formula.mathml}</munder>", rf"\sum_{k.grouped_formula.tex}"
    )
    upper_sum_limit = _number_formula(str(highest_exponent))
    lower_sum_limit = _join_formulas(n, _EQUALS_SIGN, _number_formula("0"))
    sum_over_powers = Formula(
        f"<munderover><mo>∑</mo>{lower_sum_limit.grouped_formula.mathml}{upper_sum_limit.grouped_formula.mathml}</munderover>",
        rf"\sum_{lower_sum_limit.grouped_formula.tex}^{upper_sum_limit.grouped_formula.tex}",
    )
    modal_terms = []
    for residue_symbol, pole_symbol in (
        (_variable("R"), _variable("p")),
        (_conjugate_variable("R"), _conjugate_variable("p")),
    ):
        modal_terms.append(
            _fraction(
                _subscript(residue_symbol, k),
                _join_formulas(_S_SYMBOL, _MINUS_SIGN, _subscript(pole_symbol, k)),
            )
        )
    first_term, second_term = modal_terms
    return _join_formulas(
        _TORQUE_OVER_ANGLE, _EQUALS_SIGN, sum_over_modes, _OPENING_BRACKET, first_term, _PLUS_SIGN,
        second_term,
        _CLOSING_BRACKET, _PLUS_SIGN,
        sum_over_powers, _subscript(_variable("b"), n), _power(_S_SYMBOL, n),
    )  # fmt: skip


def _conjugate_variable(variable_letter: str) -> Formula:
    """Return a letter with an overline, for the complex conjugate."""
    return Formula(
        f"<mover><mi>{variable_letter}</mi><mo>¯</mo></mover>", rf"\bar{{{variable_letter}}}"
    )


def equations(whole_record: WholeRecord) -> tuple[Formula, ...]:
    """Return the equations of a record's models: modal model, if there is one, and beam.

    The beam's equations are those of its measured response, Eq. 25 of the reference paper, and beta
    in Eq. 25. Only the damping terms of the reported structure are in them.
    """
    modal_equations = () if whole_record.headline.modal is None else (_modal_equation(),)
    return (
        *modal_equations,
        _measured_equation(whole_record.fit),
        *_beam_equations(_reported_structure(whole_record)),
    )


def _reported_structure(whole_record: WholeRecord) -> Structure:
    """Return the damping structure to which the reported parameters belong.

    If the parameters are estimated with a tolerance of the beam's geometry, the orders of internal
    and external damping are both free.
    """
    return (
        whole_record.fit.structure if whole_record.headline.tolerant is None else STRUCTURES["VI"]
    )


_EFFECT_DEFINITIONS: Final = {
    "tip_mass_kg": "G is that of a beam with the mass m at its tip",
    "filter_time_constant_s": "T is the time constant of the torque channel's filter",
    "second_order_filter_time_constant_s": "T is the reciprocal corner of the torque channel's "
    "filter (Butterworth)",
    "drag": "the drag ½ ρ_air C_D d v |v| per length also acts on the beam (ρ_air 1.2 kg/m³)",
}
"""Definitions of the symbols of additional effects, by parameter name."""


def definitions(whole_record: WholeRecord) -> str:
    """Return a text that defines the symbols of the equations that are not in any table."""
    definition_sentences = [
        "On the left coupling torque over motor angle, as Laplace transforms",
        f"L = {whole_record.record.beam.length_m:g} m is the length from the axis to the tip",
        "powers of s are principal values",
    ]
    if whole_record.headline.modal is not None:
        definition_sentences[1:1] = [
            "first the modal model, with a pole p and a residue R for each mode, which gives the "
            "modes; below it that of the beam, which gives the parameters",
        ]
    parameter_names = whole_record.headline.parameters
    definition_sentences += [
        effect_definition
        for parameter_name, effect_definition in _EFFECT_DEFINITIONS.items()
        if parameter_name in parameter_names
    ]
    return f"{'; '.join(definition_sentences)}. The numbers are in the table of the parameters."


def types_table(whole_record: WholeRecord) -> Table:
    """Return the table of damping types I to VII with their internal and external terms."""
    order_adjectives = {False: "fractional", True: "integer"}

    def structure_rows() -> Iterator[tuple[str, str, str, str]]:
        for structure in STRUCTURES.values():
            term_descriptions, damping_terms = [], []
            for is_present, damping_name, coefficient_name, order_name, order_symbol in (
                (structure.has_internal_damping, "internal", "ζ", "alpha", "α"),
                (structure.has_external_damping, "external", "γ", "lambda", "λ"),
            ):
                is_first_order = order_name not in structure.free
                damping_terms.append(
                    f"{coefficient_name} s{'' if is_first_order else '^' + order_symbol}"
                    if is_present
                    else ABSENT_TEXT
                )
                if is_present:
                    term_descriptions.append(
                        f"{damping_name} of {order_adjectives[is_first_order]} order"
                    )
            yield structure.name, damping_terms[0], damping_terms[1], ", ".join(term_descriptions)

    return Table.from_rows(
        "types",
        "Types of damping",
        (
            Column("Type", "type", TEXT_FORMAT),
            Column("Internal", "internal", TEXT_FORMAT),
            Column("External", "external", TEXT_FORMAT),
            Column("Damping", "damping", TEXT_FORMAT),
        ),
        structure_rows(),
        (
            "Internal damping multiplies EI by 1 + the term, external damping adds the term to "
            'ρ/EI s². I to VI as in the paper, VII as its conclusions propose. "Modes free": each '
            "mode with its own stiffness. The marked type is that of the reported numbers.",
        ),
        highlighted_row=list(STRUCTURES).index(_reported_structure(whole_record).name),
    )


def mathml(formula: Formula) -> str:
    """Return a formula as a MathML element for a page, with its LaTeX as annotation."""
    return (
        f'<math display="block"><semantics><mrow>{formula.mathml}</mrow>'
        f'<annotation encoding="application/x-tex">{formula.tex}</annotation></semantics></math>'
    )


def latex(formulas: tuple[Formula, ...]) -> str:
    r"""Return formulas as an ``align`` environment of LaTeX's amsmath."""
    formula_lines = (formula.tex.replace(" = ", " &= ", 1) for formula in formulas)
    align_body = " \\\\\n  ".join(formula_lines)
    return f"\\begin{{align}}\n  {align_body}\n\\end{{align}}\n"

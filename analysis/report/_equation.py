"""The model of a record as an equation with the terms that were selected, as MathML and LaTeX."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Final, NamedTuple

from analysis.identify import BACKGROUND
from analysis.models import STRUCTURES
from analysis.report.table import ABSENT, WORDS, Column, Table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.identify import RecordFit
    from analysis.models import Structure
    from analysis.results import WholeRecord


class Formula(NamedTuple):
    """One formula in two languages: presentation MathML without its root, and LaTeX."""

    mathml: str
    tex: str

    def __add__(self, other: object) -> Formula:
        """Set one behind the other."""
        if not isinstance(other, Formula):
            return NotImplemented
        return Formula(self.mathml + other.mathml, f"{self.tex} {other.tex}")

    @property
    def row(self) -> Formula:
        """The formula as one argument of another."""
        return Formula(f"<mrow>{self.mathml}</mrow>", f"{{{self.tex}}}")


def _name(letter: str, tex: str = "") -> Formula:
    return Formula(f"<mi>{letter}</mi>", tex or letter)


def _sign(text: str, tex: str = "") -> Formula:
    return Formula(f"<mo>{text}</mo>", tex or text)


def _number(text: str) -> Formula:
    return Formula(f"<mn>{text}</mn>", text)


def _power(base: Formula, exponent: Formula) -> Formula:
    up = exponent.row
    return Formula(f"<msup>{base.row.mathml}{up.mathml}</msup>", f"{base.tex}^{up.tex}")


def _indexed(base: Formula, index: Formula) -> Formula:
    down = index.row
    return Formula(f"<msub>{base.row.mathml}{down.mathml}</msub>", f"{base.tex}_{down.tex}")


def _over(above: Formula, below: Formula) -> Formula:
    a, b = above.row, below.row
    return Formula(f"<mfrac>{a.mathml}{b.mathml}</mfrac>", rf"\frac{a.tex}{b.tex}")


def _of(function: str, argument: Formula) -> Formula:
    """Apply a function whose name has several letters to an argument in brackets."""
    word = Formula(f"<mi>{function}</mi><mo>&#x2061;</mo>", rf"\{function}")
    return _joined(word, _OPEN, argument, _CLOSE)


def _joined(*parts: Formula) -> Formula:
    return reduce(Formula.__add__, parts)


_S: Final = _name("s")
_L: Final = _name("L")
_G: Final = _name("G")
_EI: Final = _name("E") + _name("I")
_BETA: Final = _name("β", r"\beta")
_ZETA, _ALPHA = _name("ζ", r"\zeta"), _name("α", r"\alpha")
_GAMMA, _LAMBDA = _name("γ", r"\gamma"), _name("λ", r"\lambda")
_PLUS, _MINUS, _IS = _sign("+"), _sign("−", "-"), _sign("=")
_OPEN, _CLOSE = _sign("("), _sign(")")
_ONE, _TWO = _number("1"), _number("2")
_OF_S: Final = _OPEN + _S + _CLOSE


_TORQUE_OVER_ANGLE: Final = _over(
    _indexed(_name("Γ", r"\Gamma"), Formula("<mtext>coup</mtext>", r"\mathrm{coup}")) + _OF_S,
    _indexed(_name("Θ", r"\Theta"), _name("m")) + _OF_S,
)


def _term(coefficient: Formula, order: Formula, *, integer: bool) -> Formula:
    return coefficient + (_S if integer else _power(_S, order))


def _elastic(structure: Structure) -> Formula | None:
    """``1 + zeta s^alpha`` with what the structure has of it; None without internal damping."""
    if not structure.internal:
        return None
    return _joined(_ONE, _PLUS, _term(_ZETA, _ALPHA, integer="alpha" not in structure.free))


def _inertial(structure: Structure) -> Formula:
    ratio = _over(_name("ρ", r"\rho"), _EI)
    # In display size although it is inside a fraction.
    large = f'<mstyle displaystyle="true">{ratio.mathml}</mstyle>'
    inertia = Formula(large, ratio.tex.replace("frac", "dfrac")) + _power(_S, _TWO)
    if not structure.external:
        return inertia
    return _joined(inertia, _PLUS, _term(_GAMMA, _LAMBDA, integer="lambda" not in structure.free))


def _of_beam(structure: Structure) -> tuple[Formula, Formula]:
    """Eq. 25 with its beta."""
    elastic, z = _elastic(structure), _BETA + _L
    sin, cos, sinh, cosh = (_of(name, z) for name in ("sin", "cos", "sinh", "cosh"))
    stiffness = _EI if elastic is None else _joined(_EI, _OPEN, elastic, _CLOSE)
    above = _joined(sin, cosh, _MINUS, cos, sinh)
    below = _joined(_ONE, _PLUS, cos, cosh)
    response = _joined(_G, _OF_S, _IS, _MINUS, stiffness, _BETA, _over(above, below))
    inertial = _inertial(structure)
    loaded = (_OPEN + inertial + _CLOSE) if elastic is None else _over(inertial, elastic)
    return response, _joined(_power(_BETA, _number("4")), _IS, _MINUS, loaded)


def _measured(fit: RecordFit) -> Formula:
    """Torque over angle as measured: beam, tool and channels."""
    beam = _G + _OF_S
    names = fit.parameters
    inside = _joined(beam, _PLUS, _name("J"), _power(_S, _TWO))
    late = _power(_name("e"), _joined(_MINUS, _name("τ", r"\tau"), _S))
    found = _joined(_sign("[", r"\left["), inside, _sign("]", r"\right]"), late)
    time = _name("T") + _S
    if "filter_time_constant_s" in names:
        found += _over(_ONE, _joined(_ONE, _PLUS, time))
    if "second_order_filter_time_constant_s" in names:
        root = Formula(f"<msqrt>{_TWO.mathml}</msqrt>", r"\sqrt{2}")
        square = _power(_name("T"), _TWO) + _power(_S, _TWO)
        found += _over(_ONE, _joined(_ONE, _PLUS, root, time, _PLUS, square))
    return _joined(_TORQUE_OVER_ANGLE, _IS, found)


def _modal() -> Formula:
    """Modal model: poles and residues, and a background."""
    k, n, background = _name("k"), _name("n"), BACKGROUND - 1
    over_modes = Formula(f"<munder><mo>∑</mo>{k.row.mathml}</munder>", rf"\sum_{k.row.tex}")
    limit = _number(str(background))
    from_zero = _joined(n, _IS, _number("0"))
    over_powers = Formula(
        f"<munderover><mo>∑</mo>{from_zero.row.mathml}{limit.row.mathml}</munderover>",
        rf"\sum_{from_zero.row.tex}^{limit.row.tex}",
    )
    terms = []
    for residue, pole in ((_name("R"), _name("p")), (_conjugate("R"), _conjugate("p"))):
        terms.append(_over(_indexed(residue, k), _joined(_S, _MINUS, _indexed(pole, k))))
    first, second = terms
    return _joined(
        _TORQUE_OVER_ANGLE, _IS, over_modes, _OPEN, first, _PLUS, second, _CLOSE, _PLUS,
        over_powers, _indexed(_name("b"), n), _power(_S, n),
    )  # fmt: skip


def _conjugate(letter: str) -> Formula:
    return Formula(f"<mover><mi>{letter}</mi><mo>¯</mo></mover>", rf"\bar{{{letter}}}")


def equations(whole: WholeRecord) -> tuple[Formula, ...]:
    """Write the models of a record: the modal one if there is one, and the beam's.

    Returns
    -------
    tuple of Formula
        Modal model; what was measured of a beam, Eq. 25 of the paper, and its beta: with the terms
        that the structure has.
    """
    modal = () if whole.headline.modal is None else (_modal(),)
    return *modal, _measured(whole.fit), *_of_beam(_structure(whole))


def _structure(whole: WholeRecord) -> Structure:
    """Structure of the parameters reported: with a tolerance of the geometry both orders."""
    return whole.fit.structure if whole.headline.tolerant is None else STRUCTURES["VI"]


_EXTRAS: Final = {
    "tip_mass_kg": "G is that of a beam with the mass m at its tip",
    "filter_time_constant_s": "T is the time constant of the torque channel's filter",
    "second_order_filter_time_constant_s": "T is the reciprocal corner of the torque channel's "
    "filter (Butterworth)",
    "drag": "the drag ½ ρ_air C_D d v |v| per length also acts on the beam (ρ_air 1.2 kg/m³)",
}


def definitions(whole: WholeRecord) -> str:
    """Define the symbols of the equations that no table has."""
    parts = [
        "On the left coupling torque over motor angle, as Laplace transforms",
        f"L = {whole.record.beam.length_m:g} m is the length from the axis to the tip",
        "powers of s are principal values",
    ]
    if whole.headline.modal is not None:
        parts[1:1] = [
            "first the modal model with a pole p and a residue R of each mode, which the modes are "
            "of, below it the beam's, which the parameters are of",
        ]
    names = whole.headline.parameters
    parts += [words for name, words in _EXTRAS.items() if name in names]
    return f"{'; '.join(parts)}. The numbers are in the table of the parameters."


def types_table(whole: WholeRecord) -> Table:
    """Return the table of damping types: terms, and number of parameters."""
    words = {False: "fractional", True: "integer"}

    def rows() -> Iterator[tuple[str, str, str, str]]:
        for structure in STRUCTURES.values():
            described, terms = [], []
            for present, what, coefficient, order, symbol in (
                (structure.internal, "internal", "ζ", "alpha", "α"),
                (structure.external, "external", "γ", "lambda", "λ"),
            ):
                integer = order not in structure.free
                terms.append(
                    f"{coefficient} s{'' if integer else '^' + symbol}" if present else ABSENT
                )
                if present:
                    described.append(f"{what} of {words[integer]} order")
            yield structure.name, terms[0], terms[1], ", ".join(described)

    return Table.of(
        "types",
        "Types of damping",
        (
            Column("Type", "type", WORDS),
            Column("Internal", "internal", WORDS),
            Column("External", "external", WORDS),
            Column("Damping", "damping", WORDS),
        ),
        rows(),
        (
            "Internal damping multiplies EI by 1 + the term, external damping adds the term to "
            'ρ/EI s². I to VI as in the paper, VII as its conclusions propose. "Modes free": each '
            "mode with its own stiffness. The marked type is that of the numbers reported.",
        ),
        selected=list(STRUCTURES).index(_structure(whole).name),
    )


def mathml(formula: Formula) -> str:
    """Write a formula for a page, with its LaTeX as annotation."""
    return (
        f'<math display="block"><semantics><mrow>{formula.mathml}</mrow>'
        f'<annotation encoding="application/x-tex">{formula.tex}</annotation></semantics></math>'
    )


def latex(formulas: tuple[Formula, ...]) -> str:
    r"""Write formulas as a block ``align`` of LaTeX's amsmath."""
    lines = (each.tex.replace(" = ", " &= ", 1) for each in formulas)
    body = " \\\\\n  ".join(lines)
    return f"\\begin{{align}}\n  {body}\n\\end{{align}}\n"

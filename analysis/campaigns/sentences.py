"""Sentences of a campaign's verdict: whether there is one specimen, and its damping."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns._experiment import fact_text, in_dispute
from analysis.campaigns._statistics import BEST
from analysis.campaigns._welch_bias import LARGEST_MISFIT
from analysis.identify.sentences import LOSSES
from analysis.models import COEFFICIENT_OF, QUANTITIES, STRUCTURES
from analysis.statistics import student_t_quantile
from rigd.printable import listed
from rigd.units import decimals, to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from analysis.campaigns._experiment import StatedSpecimen
    from analysis.campaigns._homogeneity import Heterogeneity, Homogeneity, Values
    from analysis.campaigns._orders import PooledOrder
    from analysis.campaigns._validation import LeftOutError, LostTrial
    from analysis.campaigns._welch_bias import ParameterBias, WelchBias
    from analysis.campaigns.pooling import PooledEstimate, PooledMode
    from analysis.identify.headline import ReportedLossFactor
    from analysis.identify.profile_likelihood import Order


# Names and numbers

_NAMES: Final = {"delay_s": "delay of the torque", "tool_inertia_kg_m2": "tool inertia"}
"""Names of quantities whose symbol alone is not clear."""
_FINER: Final = {"bending_stiffness_n_m2": ("1e-3 N·m²", 1e3)}
"""Units smaller than a single record's, because scatter between sessions needs more digits."""
_SUPERSCRIPTS: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

_LEAST: Final = 1e-99
_OF_MODES: Final = {
    "frequency_hz": ("frequency", 1.0, "Hz"),
    "damping_ratio": ("damping ratio", 100.0, "%"),
}


def label(quantity: str) -> tuple[str, float, str]:
    """Symbol, factor and unit in which a parameter or a mode's quantity is shown."""
    if quantity in QUANTITIES:
        symbol, _, unit, factor = QUANTITIES[quantity]
        unit, factor = _FINER.get(quantity, (unit, factor))
        power, _, rest = unit.partition(" ")
        if power.startswith("1e"):
            unit = f"10{power.removeprefix('1e').translate(_SUPERSCRIPTS)} {rest}"
        return _NAMES.get(quantity, symbol), factor, "" if unit == "1" else unit
    of_mode, mode = quantity.rsplit("_", 1)
    what, factor, unit = _OF_MODES[of_mode]
    return f"{what} of mode {mode}", factor, unit


def with_unit(parameter: str) -> str:
    """Symbol with its unit, if it has one.

    Examples
    --------
    >>> from analysis.campaigns.sentences import with_unit
    >>> with_unit("zeta"), with_unit("frequency_hz_2")
    ('ζ (10⁻⁵ s^α)', 'frequency of mode 2 (Hz)')
    """
    symbol, _, unit = label(parameter)
    return f"{symbol} ({unit})" if unit else symbol


def probability(chance: float) -> str:
    """Format a probability that may be too small for a number, but is not 0.

    Examples
    --------
    >>> from analysis.campaigns.sentences import probability
    >>> probability(0.0312), probability(0.0)
    ('0.031', '< 1e-99')
    """
    return f"{chance:.2g}" if chance > _LEAST else f"< {_LEAST:g}"


def percent(fraction: float) -> str:
    """Format a fraction that may be close to 1, but is not 1.

    Examples
    --------
    >>> from analysis.campaigns.sentences import percent
    >>> percent(0.4321), percent(0.99999)
    ('43.2 %', '> 99.9 %')
    """
    return "> 99.9 %" if fraction > 0.999 else f"{100 * fraction:.3g} %"


# One specimen or several

MIXTURE_MARK: Final = "‡"
_OF_MIXTURE: Final = "of a mixture"
MIXTURE_NOTE: Final = (
    f"{MIXTURE_MARK} sessions differ by more than their uncertainties: the mean of a "
    "mixture, which may be valid for none of them."
)
_MANY: Final = 5
_SLIGHT: Final = 2e-3
"""Scatter of frequencies that one beam may have: ten kelvin change steel's stiffness by 0.3 %."""


def specimens(found: Homogeneity) -> list[str]:
    """Describe that sessions are not of one specimen; empty if they are."""
    stated = _stated(found.specimens) if len(found.specimens) > 1 else []
    leading = found.leading
    return stated if leading is None else [*stated, *_differing(found, leading)]


def title(text: str, found: Homogeneity) -> str:
    """Add to a title that its values are pooled over a mixture.

    Parameters
    ----------
    text : str
        The title.
    found : Homogeneity
        Whether the sessions are of one specimen.
    """
    return f"{text}, {_OF_MIXTURE}" if found.mixed else text


def _stated(found: Sequence[StatedSpecimen]) -> list[str]:
    keys = in_dispute(found)
    each = "; ".join(
        ", ".join(f"{key} {fact_text(key, one.facts[key])}" for key in keys if key in one.facts)
        + f" in {_files(one.files)}"
        for one in found
    )
    first = ", ".join(f"{key} {fact_text(key, found[0].facts[key])}" for key in keys)
    return [
        f"The files state {len(found)} different specimens: {each}. Specimens are never "
        f"pooled: all results below are for {first}. Analyse the files of the others separately, "
        "or correct the metadata where they are wrong."
    ]


def _differing(found: Homogeneity, leading: Heterogeneity) -> list[str]:
    others = [
        label(each.quantity)[0]
        for each in found.quantities
        if each.mixed and not each.of_rig and each is not leading
    ]
    also = f" The same holds of {', '.join(others)}." if others else ""
    return [
        f"The sessions are not of one specimen in one state: {_scatter(leading)}.{also}",
        f"{_where(leading)} Pooled values are then means of a mixture (marked {MIXTURE_MARK}) that "
        "may hold for none of the specimens: analyse the sessions of each specimen separately, or "
        f"find what changed between sessions (clamp, temperature, wear).{_slight(found)}",
    ]


def _slight(found: Homogeneity) -> str:
    """Describe a scatter of many standard deviations only because these are small."""
    frequencies = [each for each in found.quantities if each.quantity.startswith("frequency_hz")]
    mixed = [each for each in frequencies if each.mixed]
    if not mixed or any(each.between_std > _SLIGHT * each.mean for each in mixed):
        return ""
    return (
        f" Frequencies vary by less than {100 * _SLIGHT:g} %, as those of one beam may when its "
        "temperature or clamp changes."
    )


def _scatter(each: Heterogeneity) -> str:
    """Describe the scatter of a quantity, relative to its uncertainty and to its size."""
    percents = percent(each.i_squared)
    equals = "" if percents.startswith(">") else "= "
    size = _rounded([each.between_std], each)
    scatter = f"{size}, {100 * each.between_std / abs(each.mean):.2g} %; " if each.mean else ""
    return (
        f"{label(each.quantity)[0]} varies between sessions by {each.own_stds:.3g} of its own "
        f"standard deviations ({scatter}Cochran's Q = {each.cochran_q:.3g} where "
        f"{each.degrees_of_freedom} is expected, I² {equals}{percents})"
    )


def _where(each: Heterogeneity) -> str:
    """Describe the groups of sessions, or the outermost ones."""
    name, _, _ = label(each.quantity)
    values = {file: (value, std) for file, value, std in each.values}
    if each.groups:
        parts = "; ".join(
            f"{_rounded([values[file][0] for file in part], each)} in {_files(part)}"
            for part in each.groups
        )
        return f"By the {name} they are {len(each.groups)} groups: {parts}."
    low, high = _ends(each.values)
    return (
        f"There are no clear groups: the {name} goes from {_rounded([low[1]], each)} in {low[0]} "
        f"to {_rounded([high[1]], each)} in {high[0]}."
    )


def _ends(values: Values) -> tuple[tuple[str, float, float], tuple[str, float, float]]:
    ordered = sorted(values, key=lambda each: each[1])
    return ordered[0], ordered[-1]


def _rounded(values: Sequence[float], each: Heterogeneity) -> str:
    """Format means with enough digits to distinguish them."""
    _, factor, unit = label(each.quantity)
    digits = min(decimals(factor * max(each.between_std, 1e-300)), 9)
    times = "·" if unit.startswith("10") else " "
    return f"{factor * float(np.mean(values)):.{digits}f}{times}{unit}".rstrip()


def _files(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MANY]) + (
        f" and {len(names) - _MANY} more" if len(names) > _MANY else ""
    )
    return f"{len(names)} file{'' if len(names) == 1 else 's'} ({shown})"


# Verdict

_OF: Final = {"alpha": "internal damping", "lambda": "external damping"}
_ORDERS: Final[tuple[Order, ...]] = ("alpha", "lambda")
_CLASSICAL: Final = "III"
"""Type of integer orders with both dampings."""
_SIGNIFICANT: Final = 0.01
_AS_GOOD: Final = 1.01


_NEARLY_INTEGER: Final = 0.05
"""Distance from 1 within which an order is called nearly integer although 1 is excluded."""


def answer(
    freest: PooledEstimate,
    alpha: PooledOrder,
    lambda_: PooledOrder,
    validation: Sequence[LeftOutError],
) -> str:
    """Describe the orders of the dampings, and the predictions of the classical and freest types.

    Parameters
    ----------
    freest : PooledEstimate
    alpha, lambda_ : PooledOrder
    validation : sequence of LeftOutError
    """
    joint = " and " if alpha.exact is None else "; "
    dampings = f"{_answered(alpha)}{joint}{_answered(lambda_)}"
    sentence = f"{dampings[0].upper()}{dampings[1:]}."
    errors: dict[str, list[str]] = {}
    for name in dict.fromkeys((_CLASSICAL, freest.name)):
        its = [e.error for e in validation if e.method == "record" and e.name == name]
        if its:
            errors.setdefault(f"{100 * float(np.mean(its)):.2g} %", []).append(name)
    if not errors:
        return sentence
    each = ", ".join(
        f"type{'s' if len(names) > 1 else ''} {listed(names)} with {error}"
        for error, names in errors.items()
    )
    return f"{sentence} Error of the torque predicted for an unseen session: {each}."


def _answered(found: PooledOrder) -> str:
    """Describe the order of a damping in a few words."""
    if found.exact is not None:
        return _effective(found)
    of = _OF[found.order]
    if found.status == "absent":
        return f"no {of}"
    if found.status == "compatible" and found.interval is None:
        return f"{of} of order 1 ({found.order} was not fitted)"
    if found.value is None or found.interval is None or found.reason is not None:
        return f"{of} of an order that is not established"
    half = (found.interval[1] - found.interval[0]) / 2
    number = " ± ".join(to_uncertainty((found.value, half), found.std or half))
    value = f"{found.order} = {number}"
    if found.status == "compatible":
        return f"{of} of integer order ({value})"
    if found.status == "open":
        return f"{of} of an order near 1 ({value}; 1 is doubtful, but not excluded)"
    if abs(found.value - 1) < _NEARLY_INTEGER:
        return f"{of} of nearly integer order ({value}; 1 is excluded)"
    return f"{of} of fractional order ({value})"


def _effective(found: PooledOrder) -> str:
    """Describe the growth of a loss over the visible modes in a few words."""
    loss = LOSSES[found.order]
    if found.value is None or found.interval is None or found.reason is not None:
        return f"{loss} with a slope that is not established"
    half = (found.interval[1] - found.interval[0]) / 2
    number = " ± ".join(to_uncertainty((found.value, half), found.std or half))
    conclusion = {
        "compatible": "consistent with order 1",
        "fractional": "which excludes order 1",
        "open": "which alone does not exclude order 1",
    }
    return f"{loss} growing as f^({number}), {conclusion[found.status]}"


def headline(freest: PooledEstimate, best: PooledEstimate) -> str:
    """Describe the structure of the numbers, and a simpler sufficient one.

    Parameters
    ----------
    freest : PooledEstimate
    best : PooledEstimate
        Estimate of the lowest BIC.
    """
    given = [name for name in _ORDERS if STRUCTURES[freest.structure].fixed.get(name) == 1.0]
    are = "is" if len(given) == 1 else "are"
    so = (
        f"; it assumes that {' and '.join(given)} {are} 1."
        if given
        else ", so its intervals hold for any simpler one, too."
    )
    sentence = (
        f"The numbers are those of type {freest.name}: {_damping(freest.structure)}. "
        f"It is the freest structure that the sessions determine{so}"
    )
    if best.name != freest.name:
        sentence += (
            f" Type {best.name} has the lowest BIC ({_damping(best.structure)}); "
            "its intervals are narrower, and valid only if it is true."
        )
    return sentence


def sizes(found: Sequence[ReportedLossFactor]) -> list[str]:
    """Describe each damping at its pivot frequency, where it depends least on its order."""
    factors = []
    for each in found:
        if each.omega_rad_s is None or not (each.size.std and each.size.interval_95):
            continue
        value, low, high = to_uncertainty((each.size.value, *each.size.interval_95), each.size.std)
        flag = f", {each.size.flag}" if each.size.flag else ""
        factors.append(
            f"{each.damping} {value} (95 %: {low} to {high}) at "
            f"{each.omega_rad_s / (2 * np.pi):.3g} Hz{flag}"
        )
    return [f"Loss factors at the pivot frequencies: {'; '.join(factors)}."] if factors else []


def selected(
    ranked: Sequence[PooledEstimate],
    close: Sequence[PooledEstimate],
    alone: Mapping[str, int],
    sessions: int,
) -> str:
    """Describe the structure that all sessions select together, its equals, and the agreement.

    Parameters
    ----------
    ranked : sequence of PooledEstimate
        The lowest BIC first.
    close : sequence of PooledEstimate
        Those whose BIC does not distinguish them from the first.
    alone : mapping of str to int
        How many sessions select each structure by themselves.
    sessions : int
        Number of sessions.
    """
    best = ranked[0]
    sentence = f"Lowest BIC: type {best.name}."
    if close:
        names = " or ".join(f"type {each.name}" for each in close)
        sentence += (
            f" All sessions together do not distinguish it from {names} (ΔBIC "
            f"{close[0].bic - best.bic:.1f}; 10 = decisive)."
        )
    elif len(ranked) > 1:
        margin = ranked[1].bic - best.bic
        sentence += f" Next: type {ranked[1].name}, ΔBIC {margin:.3g} (10 = decisive)."
    selections = {f"type {name}": count for name, count in alone.items()}
    return f"{sentence} {in_single_sessions(selections, sessions)}"


def left_over(best: PooledEstimate, adequate: int, sessions: int) -> str:
    """Describe whether the residual of a structure is noise.

    Parameters
    ----------
    best : PooledEstimate
        Estimate of that structure.
    adequate : int
        Sessions whose residual is noise.
    sessions : int
        Number of sessions.
    """
    if best.misfit > LARGEST_MISFIT:
        return (
            f"Its residual is {best.misfit:.3g} times the noise: no structure fitted describes the "
            "beam, and standard deviations are meaningless."
        )
    return noise_alone(adequate, sessions)


def noise_alone(adequate: int, sessions: int) -> str:
    """State in how many sessions the residual is noise.

    Parameters
    ----------
    adequate : int
        Sessions whose residual is noise.
    sessions : int
        Number of sessions.
    """
    if adequate == sessions:
        return "The residual is noise in every session: the model suffices for these records."
    return (
        f"The residual is noise in {adequate} of {sessions} sessions; in the others something is "
        "unexplained."
    )


def modes(found: Sequence[PooledMode], sessions: int, *, mixed: bool) -> list[str]:
    """Describe the damping of the modes.

    Parameters
    ----------
    found : sequence of PooledMode
        The modes.
    sessions : int
        Number of sessions.
    mixed : bool
        Whether the sessions are of several specimens.
    """
    if not found:
        return []
    t = student_t_quantile(0.95, sessions - 1)
    modes = "; ".join(_mode(each, t) for each in found)
    of = "the sessions, a mixture" if mixed else "the sessions"
    return [f"Modes: {modes} (± 95 % of the mean over {of})."]


def order(found: PooledOrder) -> str:
    """Describe the estimate of one order."""
    name, of = found.order, _OF[found.order]
    counts = {f"“{status}”": count for status, count in found.alone.items()}
    alone = f" {in_single_sessions(counts, sum(counts.values()))}"
    if found.status == "absent":
        return f"No {of} was found, so its order {name} has no meaning.{alone}"
    if found.status == "compatible" and found.interval is None:
        return f"The order {name} of the {of} is fixed at 1, with which it is compatible.{alone}"
    if found.value is None or found.interval is None:
        return f"The order {name} of the {of} is not identifiable: {found.reason}.{alone}"
    half = (found.interval[1] - found.interval[0]) / 2
    value, low, high = to_uncertainty((found.value, *found.interval), found.std or half)
    is_ = (
        f"The order {name} of the {of} is {value} "
        f"(95 %: {low} to {high}, between-session variance included)"
    )
    if found.reason is not None:
        would = is_.replace(" is ", " would be ", 1)
        return f"{would}, but {found.reason}; do not interpret it.{alone}"
    conclusion = {
        "compatible": "consistent with 1",
        "fractional": "1 is excluded",
        "open": "1 is doubtful, but not excluded",
    }
    return f"{is_}: {conclusion[found.status]}.{alone}"


def welch_bias(
    freest: PooledEstimate,
    biases: Sequence[WelchBias],
    withheld: Collection[str],
    *,
    comparable: bool,
) -> list[str]:
    """Describe the bias of the Welch fits of the reported type.

    Parameters
    ----------
    freest : PooledEstimate
    biases : sequence of WelchBias
    withheld : collection of str
        Orders that are not reported; their coefficients are not, either.
    comparable : bool
        Whether the sessions are of one specimen, and a uniform beam predicts its modes: else there
        is nothing to compare with.
    """
    if not comparable:
        return []
    of_type = [each for each in biases if each.structure == freest.name]
    best = [each for each in of_type if (each.structure, each.weighting) in BEST]
    left_out = {*withheld, *(COEFFICIENT_OF[order] for order in withheld)}
    sentences = []
    for each in best or of_type[:1]:
        found = [one for one in each.significant if one.parameter not in left_out]
        if not found:
            continue
        sentences.append(
            f"Welch's {'; '.join(map(_biased, found))} (type {each.structure}, weights "
            f"{each.weighting}, as in Table 3): bias, not scatter, which more sessions do not "
            "reduce."
        )
        if each.wmse < each.record_wmse:
            sentences.append(
                f"The lower WMSE of the Welch fits ({each.wmse:.3g} against "
                f"{each.record_wmse:.3g} (N·m/rad)²) is no evidence for them: it is the distance "
                "from Welch's response, which has the same bias."
            )
    return sentences


def _biased(each: ParameterBias) -> str:
    """Describe a parameter of a Welch fit and its bias."""
    symbol, factor, unit = label(each.parameter)
    value, scatter = to_uncertainty((each.welch, each.welch_std), each.welch_std, factor)
    (record,) = to_uncertainty((each.record,), each.record_std, factor)
    (size,) = to_uncertainty((abs(each.bias),), each.bias_std, factor)
    name = each.parameter if each.parameter in _ORDERS else symbol
    times = f"·{unit}" if unit else ""
    edge = f", at the edge of the search range in {each.at_bounds}" if each.at_bounds else ""
    return (
        f"{name} ({value} ± {scatter}{times} between sessions{edge}) is {size}{times} "
        f"{'above' if each.bias > 0 else 'below'} the whole records' {record}{times}"
    )


def dissenting(who: Sequence[tuple[str, str]], best: PooledEstimate) -> list[str]:
    """Name the sessions that by themselves exclude the structure selected by all together.

    Parameters
    ----------
    who : sequence of tuple
        File of each session, and the structure that it selects.
    best : PooledEstimate
        Estimate of the structure that all select.
    """
    if not who:
        return []
    names = ", ".join(f"{file} (type {structure})" for file, structure in who[:_MANY])
    more = f" and {len(who) - _MANY} more" if len(who) > _MANY else ""
    return [
        f"Type {best.name} is excluded by {len(who)} single session{'s' if len(who) > 1 else ''}: "
        f"{names}{more}. Check their reports (analyze --each) before relying on the mean."
    ]


def scatter(best: PooledEstimate) -> str:
    """Describe whether the sessions repeat, with one false alarm in a hundred campaigns."""
    level = _SIGNIFICANT / max(len(best.parameters), 1)
    moved = [label(each.name)[0] for each in best.parameters if each.chance < level]
    if not moved:
        lowest = min((each.chance for each in best.parameters), default=1.0)
        tau = (
            "; the τ above zero are within chance"
            if any(each.between_std > 0 for each in best.parameters)
            else ""
        )
        return (
            "No significant between-session variance (Cochran's Q, lowest p of "
            f"{len(best.parameters)}: {probability(lowest)}{tau})."
        )
    return (
        f"Between-session variance in {', '.join(moved)} (Cochran's Q): something changes between "
        "sessions, such as clamp, temperature or motor, and the interval of a single session is "
        "too narrow for the specimen."
    )


def foresight(best: PooledEstimate, validation: Sequence[LeftOutError], sessions: int) -> list[str]:
    """Describe how well the sessions predict an unseen one.

    Parameters
    ----------
    best : PooledEstimate
        Estimate of the structure in question.
    validation : sequence of LeftOutError
        Errors of sessions predicted from the others.
    sessions : int
        Number of sessions.
    """
    of_best = [each for each in validation if each.method == "record" and each.name == best.name]
    own = [each.own_error for each in of_best if each.own_error is not None]
    if not own:
        return []
    error, alone = float(np.mean([each.error for each in of_best])), float(np.mean(own))
    verdict = (
        "the others predict a session as well as its own fit"
        if error <= _AS_GOOD * alone
        else "the others predict a session worse than its own fit, as the parameters vary"
    )
    fewer = f"; mean of {len(own)} of {sessions} sessions" if len(own) < sessions else ""
    return [
        f"Leave-one-out error of the torque {100 * error:.2f} % rms (in-sample "
        f"{100 * alone:.2f} %, noise included{fewer}): {verdict}."
    ]


def lost_trials(lost: Sequence[LostTrial], requested: int) -> list[str]:
    """Describe the sessions that were to be predicted and were not.

    Parameters
    ----------
    lost : sequence of LostTrial
        Sessions that were not predicted.
    requested : int
        Number of sessions to be predicted.
    """
    if not lost:
        return []
    each = "; ".join(f"{trial.path.name}: {trial.reason}" for trial in lost[:_MANY])
    more = f"; and {len(lost) - _MANY} more" if len(lost) > _MANY else ""
    return [
        f"Of {requested} sessions to be predicted from the others, {requested - len(lost)} "
        f"{'was' if requested - len(lost) == 1 else 'were'} and {len(lost)} "
        f"{'was' if len(lost) == 1 else 'were'} not ({each}{more}). Prediction errors are averaged "
        "over those predicted."
    ]


def in_single_sessions(counts: Mapping[str, int], sessions: int) -> str:
    """Describe the findings of single sessions with their numbers.

    Parameters
    ----------
    counts : mapping of str to int
        Number of sessions by what they find.
    sessions : int
        Number of sessions.
    """
    (first, count), *others = counts.items()
    more = "".join(f", {what} in {n}" for what, n in others)
    return f"Single sessions: {first} in {count} of {sessions}{more}."


def _damping(structure: str) -> str:
    """Describe the kinds of damping of a structure, and their orders."""
    shape = STRUCTURES[structure]
    kinds = [
        f"{what} damping ({order} {'free' if order in shape.free else '= 1'})"
        for what, order, present in (
            ("internal", "alpha", shape.internal),
            ("external", "lambda", shape.external),
        )
        if present
    ]
    return " and ".join(kinds)


def _mode(mode: PooledMode, t: float) -> str:
    half = t * 100 * mode.damping_ratio_std
    digits = decimals(max(half, 1e-9))
    return (
        f"{mode.frequency_hz:.5g} Hz with a damping ratio of "
        f"{100 * mode.damping_ratio:.{digits}f} ± {half:.{digits}f} %"
    )

"""Targets: texts of options, and their standard deviations by the delta method."""

from dataclasses import replace

import numpy as np
import pytest
from beam_estimates import ESTIMATE, UNIFORM

from rigd.beam import LOGARITHMIC_PARAMETERS, Damping, modes
from rigd.excitation import ExcitationError
from rigd.excitation.targets import Quantities, Target, parse_target


@pytest.mark.parametrize(
    ("quantity", "text", "target", "printed"),
    [
        ("damping", "1%", Target("damping", 0.01, True), "damping to 1 %"),
        ("damping", "2:0.5%", Target("damping", 0.005, True, 2), "damping of mode 2 to 0.5 %"),
        ("damping", "2e-5", Target("damping", 2e-5, False), "damping to 2e-05"),
        ("frequency", "1:0.002Hz", Target("frequency", 0.002, False, 1), None),
        ("frequency", "1 : 0.002 Hz", Target("frequency", 0.002, False, 1), None),
        ("zeta", "5 %", Target("zeta", 0.05, True), "zeta to 5 %"),
        ("alpha", "0.01", Target("alpha", 0.01, False), "alpha to 0.01"),
    ],
)
def test_an_option_is_read(quantity, text, target, printed):
    assert parse_target(quantity, text) == target
    assert printed is None or str(target) == printed


@pytest.mark.parametrize(
    ("quantity", "text", "message"),
    [
        ("mass", "1%", "choose from damping, frequency"),
        ("damping", "", "not a standard deviation"),
        ("damping", "1Hz", "not a standard deviation"),
        ("damping", "0%", "more than 0"),
        ("damping", "-1%", "more than 0"),
        ("alpha", "nan", "finite"),
        ("damping", "1", "for a percentage of the value write 1%"),
        ("damping", "2:0.5", "write 2:0.5%"),
        ("lambda", "5", "says nothing about lambda"),
        ("zeta", "2:5%", "not a quantity of a mode"),
        ("damping", "two:5%", "not the number of a mode"),
        ("damping", "0:5%", "not the number of a mode"),
        ("frequency", "1:0.1mHz", "a number in Hz"),
    ],
)
def test_invalid_text_is_refused_with_a_remedy(quantity, text, message):
    with pytest.raises(ExcitationError, match=message) as refused:
        parse_target(quantity, text)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("zeta", 1e-5),
        ("alpha", 1e-6),
        ("gamma", 1e-5),
        ("lambda", 1e-6),
        ("density_over_stiffness", 1e-6),
    ],
)
def test_derivatives_of_modes_match_the_model(name, step):
    """Derivatives of damping ratio and frequency, against differences of the model's own modes."""
    index, value = UNIFORM.index(name), ESTIMATE.parameter_values[name]

    def moved(by):
        moved_value = value * (1 + by) if name in LOGARITHMIC_PARAMETERS else value + by
        plant = ESTIMATE.plant.with_parameters({name: moved_value})
        return modes(plant.beam, plant.damping, 3)

    up, down = moved(step), moved(-step)
    for mode, after, before in zip(ESTIMATE.modes(), up, down, strict=True):
        ratio = (after.damping_ratio - before.damping_ratio) / (2 * step)
        hz = (after.frequency_hz - before.frequency_hz) / (2 * step)
        assert mode.damping_ratio_derivative[index] == pytest.approx(ratio, rel=1e-4, abs=1e-7)
        assert mode.frequency_derivative_hz[index] == pytest.approx(hz, rel=1e-4, abs=1e-6)


def test_target_holds_for_all_modes_by_default():
    targets = [parse_target("damping", "1%"), parse_target("frequency", "2:0.1%")]
    quantities = Quantities.from_targets([*targets, parse_target("zeta", "5%")], ESTIMATE)
    names = [each.target.name for each in quantities.quantity_precisions]
    assert names == [*(f"damping of mode {n}" for n in (1, 2, 3)), "frequency of mode 2", "zeta"]
    covariance = np.diag(np.full(len(UNIFORM), 1e-4))
    found = quantities.precisions(covariance)
    assert found[-1].std == pytest.approx(7.1e-5 * 0.01)
    assert found[-1].reached
    np.testing.assert_allclose(
        quantities.std_to_target_ratios(covariance), [each.std_to_target_ratio for each in found]
    )


def test_relative_target_of_zero_is_impossible():
    none = replace(
        ESTIMATE,
        plant=replace(ESTIMATE.plant, damping=Damping()),
        free_parameters=("density_over_stiffness",),
    )
    found = Quantities.from_targets(
        [parse_target("damping", "1%"), parse_target("alpha", "0.1")], none
    )
    precisions = found.precisions(np.eye(1))
    assert "is 0" in precisions[0].impossible_reason
    assert "internal damping is absent" in precisions[-1].impossible_reason
    assert not any(each.reached for each in precisions)

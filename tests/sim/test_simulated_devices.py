"""The plant as measured by encoder and sensor."""

from dataclasses import replace

import numpy as np
import pytest
from shipped_profile import load_shipped

from rigd.devices import open_devices
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import DeviceSelection
from rigd.sim import SimulatedRig

PERIOD_NS = 1_000_000


@pytest.fixture
def rig():
    return load_shipped("sim").rig


def watch(rig, ticks, torque_nm):
    """Angles (n,) and wrenches (n, 6) of a rig under a torque that follows `torque_nm(tick)`."""
    devices = open_devices(rig)
    devices.drive.enable()
    angles, wrenches, saturated = [], [], []
    for tick in range(ticks):
        devices.drive.latch(tick * PERIOD_NS)
        devices.sensor.request(tick * PERIOD_NS)
        angles.append(devices.drive.read_angle())
        wrenches.append(devices.sensor.read_wrench())
        saturated.append(devices.sensor.wrench_saturated)
        devices.drive.command(torque_nm(tick))
    return np.array(angles), np.array(wrenches), np.array(saturated)


def wiggle(tick):
    return 0.3 * np.sin(2 * np.pi * 0.003 * tick)


def test_angles_come_in_whole_steps(rig):
    angles, _, _ = watch(rig, 500, wiggle)
    steps = angles / rig.encoder.resolution_rad
    assert np.abs(steps - np.round(steps)).max() < 1e-6
    assert np.unique(np.round(steps)).size > 20


def test_the_wrench_has_the_stated_steps_noise_and_offset(rig):
    _, wrenches, saturated = watch(rig, 4000, lambda tick: 0.0)
    resolution = np.array(rig.sensor.resolution)
    steps = wrenches / resolution
    assert np.abs(steps - np.round(steps)).max() < 1e-6
    simulation = rig.simulation
    noise = np.array([simulation.force_noise_n] * 3 + [simulation.torque_noise_nm] * 3)
    expected = np.sqrt(noise**2 + resolution**2 / 12)
    assert wrenches.std(axis=0) == pytest.approx(expected, rel=0.06)
    assert np.abs(wrenches.mean(axis=0) - simulation.offset).max() < 4 * noise.max() / 60
    assert not saturated.any()


def test_a_sensor_at_the_end_of_its_range_reports_saturation(rig):
    narrow = replace(rig, sensor=replace(rig.sensor, range=(20.0, 20.0, 60.0, 1.0, 1.0, 0.05)))
    _, wrenches, saturated = watch(narrow, 1500, wiggle)
    assert saturated.any()
    assert np.abs(wrenches[:, 5]).max() == pytest.approx(0.05, abs=1.3e-4)
    assert (np.abs(wrenches[saturated, 5]) > 0.0498).all()


@pytest.fixture
def quiet(rig):
    """A rig whose sensor is exact."""
    return replace(
        rig,
        sensor=replace(rig.sensor, resolution=(0.0,) * 6),
        simulation=replace(
            rig.simulation, torque_noise_nm=0.0, force_noise_n=0.0, offset=(0.0,) * 6
        ),
    )


def test_coupling_torque_and_base_shear_are_projections_of_the_wrench(quiet):
    # A sensor turned by 180° about x, and off the axis: its fy has a lever arm of 3 cm.
    turned = replace(
        quiet,
        sensor=replace(
            quiet.sensor,
            projection=(0, 0.03, 0, 0, 0, -1.0),
            shear_projection=(0, -1.0, 0, 0, 0, 0),
        ),
    )
    _, straight, _ = watch(quiet, 800, wiggle)
    _, wrenches, _ = watch(turned, 800, wiggle)
    assert np.abs(straight[:, 5]).max() > 0.01
    assert np.abs(straight[:, 1]).max() > 0.02
    assert not straight[:, [0, 2, 3, 4]].any()
    assert wrenches @ np.array(turned.sensor.projection) == pytest.approx(straight[:, 5])
    assert wrenches @ np.array(turned.sensor.shear_projection) == pytest.approx(straight[:, 1])


def test_no_shear_without_its_projection(quiet):
    without_shear = replace(
        quiet,
        sensor=replace(
            quiet.sensor, projection=(0, 0.03, 0, 0, 0, -1.0), shear_projection=(0.0,) * 6
        ),
    )
    _, straight, _ = watch(quiet, 400, wiggle)
    _, wrenches, _ = watch(without_shear, 400, wiggle)
    # The smallest wrench of which the projection makes the torque.
    assert wrenches @ np.array(without_shear.sensor.projection) == pytest.approx(straight[:, 5])
    assert wrenches[:, 1] == pytest.approx(-0.03 * wrenches[:, 5])


def test_crosstalk_is_a_fixed_fraction_of_each_range(quiet):
    crossed = replace(quiet, simulation=replace(quiet.simulation, crosstalk_percent=2.0))
    _, straight, _ = watch(quiet, 400, wiggle)
    _, wrenches, _ = watch(crossed, 400, wiggle)
    full = np.array(quiet.sensor.range)
    shown = np.linalg.lstsq(straight[:, [1, 5]] / full[[1, 5]], wrenches / full)[0]
    own, other = shown[[0, 1], [1, 5]], np.delete(shown, [1, 5], axis=1)
    assert own == pytest.approx([1.0, 1.0])
    assert 0.01 < np.abs(other).max() <= 0.02 + 1e-9
    assert (np.abs(other) > 1e-3).all()
    _, again, _ = watch(replace(crossed, sensor=replace(crossed.sensor)), 400, wiggle)
    assert np.array_equal(again, wrenches)


def hum_of(quiet, ticks, **more):
    """Wrenches of a rig with the motor at rest and a hum on its torque."""
    rig = replace(quiet, simulation=replace(quiet.simulation, **more))
    return watch(rig, ticks, lambda _: 0.0)[1]


def test_a_hum_is_a_sine_on_the_projection_of_the_torque(quiet):
    turned = replace(quiet, sensor=replace(quiet.sensor, projection=(0, 0.03, 0, 0, 0, -1.0)))
    wrenches = hum_of(turned, 2000, hum_nm=5e-3, hum_hz=33.3)
    torque = wrenches @ np.array(turned.sensor.projection)
    sine = 5e-3 * np.sin(2 * np.pi * 33.3e-3 * np.arange(2000))
    assert torque == pytest.approx(sine, abs=1e-12)
    assert wrenches @ np.array(turned.sensor.shear_projection) == pytest.approx(0.0, abs=1e-15)
    # 50 Hz by default; no hum unless requested.
    mains = hum_of(quiet, 200, hum_nm=2e-3)[:, 5]
    assert mains == pytest.approx(2e-3 * np.sin(0.1 * np.pi * np.arange(200)), abs=1e-12)
    assert not hum_of(quiet, 200).any()


def test_a_hum_is_independent_of_the_beam(quiet):
    _, alone, _ = watch(quiet, 600, wiggle)
    humming = replace(quiet, simulation=replace(quiet.simulation, hum_nm=5e-3))
    angles, wrenches, _ = watch(humming, 600, wiggle)
    assert np.array_equal(angles, watch(quiet, 600, wiggle)[0])
    sine = 5e-3 * np.sin(0.1 * np.pi * np.arange(600))
    assert (wrenches - alone)[:, 5] == pytest.approx(sine, abs=1e-12)


def test_a_hum_goes_on_through_missed_periods(quiet):
    rig = replace(quiet, simulation=replace(quiet.simulation, hum_nm=5e-3, hum_hz=47.0))
    simulated = SimulatedRig(rig)
    seen, ticks = [], [0, 1, 5, 6, 40]
    for before, tick in zip([0, *ticks], ticks, strict=False):
        simulated.advance(tick - before)
        seen.append(simulated.sensor.read_wrench()[5])
    assert seen == pytest.approx(5e-3 * np.sin(2 * np.pi * 0.047 * np.array(ticks)), abs=1e-12)


def test_a_hum_is_sampled_with_every_record_of_a_stream(quiet):
    serial = load_shipped("antenna_serial").rig.ati_serial
    rig = replace(
        quiet,
        ati_serial=replace(serial, filter="mean", stream_hz=3000.0),
        simulation=replace(quiet.simulation, hum_nm=5e-3, hum_hz=700.0),
    )
    simulated = SimulatedRig(rig)
    records = []
    for _ in range(50):
        simulated.advance(1)
        records += [record[5] for record in simulated.sensor.records]
    phase = 2 * np.pi * 700.0 * np.arange(1, 151) / 3000.0
    assert records == pytest.approx(5e-3 * np.sin(phase), abs=1e-12)


def test_a_declared_delay_is_the_age_of_the_reading(rig):
    late = replace(rig, encoder=replace(rig.encoder, delay_s=2e-3, resolution_rad=0.0))
    now = replace(rig, encoder=replace(rig.encoder, resolution_rad=0.0))
    delayed, _, _ = watch(late, 400, wiggle)
    prompt, _, _ = watch(now, 400, wiggle)
    assert delayed[2:] == pytest.approx(prompt[:-2], abs=1e-12)


def test_a_profile_without_a_simulation_section_is_refused(rig):
    with pytest.raises(DeviceError, match=r"\[simulation\]"):
        open_devices(replace(rig, simulation=None))


@pytest.fixture
def streaming():
    """A rig whose sensor streams seven records a tick, simulated directly and without noise."""
    rig = load_shipped("antenna_serial").rig
    quiet = replace(rig.simulation, torque_noise_nm=0.0, force_noise_n=0.0, offset=(0.0,) * 6)
    sensor = replace(rig.sensor, resolution=(0.0,) * 6)
    return replace(
        rig, devices=DeviceSelection(drive="sim", sensor="sim"), simulation=quiet, sensor=sensor
    )


def test_a_streaming_sensor_averages_records_with_the_stated_delay(streaming):
    # At low frequency a mean over a tick differs from a delay by (ωT)²/24 only.
    point = replace(streaming, ati_serial=None)
    _, averaged, _ = watch(streaming, 800, wiggle)
    _, delayed, _ = watch(point, 800, wiggle)
    torque, expected = averaged[100:, 5], delayed[100:, 5]
    assert np.abs(torque - expected).max() < 2e-3 * np.abs(expected).max()
    # The same without the filter's delay is visibly wrong: the agreement above is meaningful.
    early = replace(point, sensor=replace(point.sensor, delay_s=0.0))
    _, undelayed, _ = watch(early, 800, wiggle)
    assert np.abs(torque - undelayed[100:, 5]).max() > 5e-3 * np.abs(expected).max()


@pytest.mark.parametrize(("shape", "gain"), [("mean", 1 / 7), ("triangle", 231 / 2401)])
def test_a_decimating_filter_reduces_noise(streaming, shape, gain):
    # Sum of the squared weights: 7/49, and (2(1² + … + 6²) + 7²)/49² = 231/2401.
    noisy = replace(
        streaming,
        simulation=replace(streaming.simulation, torque_noise_nm=5e-3),
        ati_serial=replace(streaming.ati_serial, filter=shape),
    )
    _, wrenches, _ = watch(noisy, 4000, lambda tick: 0.0)
    assert wrenches[20:, 5].std() == pytest.approx(5e-3 * np.sqrt(gain), rel=0.06)


def test_one_saturated_record_saturates_the_wrench_of_its_tick(streaming):
    narrow = replace(
        streaming, sensor=replace(streaming.sensor, range=(20.0, 20.0, 60.0, 1.0, 1.0, 0.03))
    )
    _, wrenches, saturated = watch(narrow, 800, wiggle)
    assert saturated.any()
    # The mean of a tick lies inside the range where only a part of its records is at the end.
    assert (np.abs(wrenches[saturated, 5]) < 0.03 - 1e-9).any()
    assert not saturated[np.abs(wrenches[:, 5]) < 0.02].any()


def test_a_missed_tick_passes_with_the_last_torque_held(rig):
    drive = open_devices(rig).drive
    drive.enable()
    for tick in range(5):
        drive.latch(tick * PERIOD_NS)
        drive.command(0.2)
    before = drive.read_angle()
    drive.latch(55 * PERIOD_NS)
    assert drive.read_angle() > before + 1e-3

"""Fits of a running session in the live view: intervals over time, and the table of the last."""

import json
from dataclasses import replace

import numpy as np
import pytest
from online_fits import online_fit

from rigd.session import read_session
from rigd.view import Scene, draw_session

pytestmark = pytest.mark.process

FIT_TABLE_ENTITY = "/fit_table"


@pytest.fixture
def fitted(description):
    """The paper's session as a search, of which the fits of so many modes are plotted."""
    return lambda modes=3: replace(description, fitted_mode_count=modes, excitation="until")


@pytest.fixture
def curves(fitted, shown):
    """Low and high of the target and of the interval in each plot; the estimate."""

    def last(fit, modes=3):
        scene = Scene(fitted(modes))
        found = shown(scene.initial_drawings() if fit is None else scene.fit_drawings(fit))["/fits"]
        return {name: values[-1] for name, values in found.values.items()}

    return last


@pytest.fixture
def fit_table(fitted, shown):
    """Return the text of the table of a fit."""
    return lambda fit: shown(Scene(fitted()).fit_drawings(fit))[FIT_TABLE_ENTITY].last(
        "TextDocument:text"
    )


def test_plot_has_estimate_interval_and_target(curves):
    shown = curves(online_fit(width=2.0))
    half = 1.96 * 2e-4
    assert shown["damping_1_percent"] == pytest.approx(
        [100 * (0.0091 + side) for side in (-1.96 * 9.1e-5, 1.96 * 9.1e-5, -half, half, 0.0)]
    )
    # Its frequency has no target.
    assert shown["frequency_1_hz"][2:] == pytest.approx(
        [2.5697 - 2 * half, 2.5697 + 2 * half, 2.5697]
    )
    assert np.isnan(shown["frequency_1_hz"][:2]).all()


@pytest.mark.parametrize(
    ("fit", "component"),
    [
        (online_fit(), "frequency_3_hz"),  # not visible yet
        (online_fit(third="doubtful"), "damping_3_percent"),
        ({"duration_s": 1.0, "problem": "Nothing was excited.", "text": []}, "damping_1_percent"),
        (None, "damping_1_percent"),
    ],
)
def test_unknown_values_are_not_plotted(curves, fit, component):
    assert np.isnan(curves(fit)[component]).all()


def test_plot_without_a_target_has_estimate_and_interval(fitted, shown):
    scene = Scene(replace(fitted(2), excitation="chirp"))
    found = shown(scene.fit_drawings(online_fit()))["/fits"]
    assert len(found.values) == 4
    assert all(len(values[-1]) == 3 for values in found.values.values())


def test_modes_without_a_plot_are_in_the_table_only(curves):
    assert curves(online_fit(), modes=1).keys() == {"damping_1_percent", "frequency_1_hz"}


def test_table_shows_progress_and_remaining_time(fit_table):
    table = fit_table(online_fit(width=2.0))
    assert "| damping of mode 1 | 0.0091 | **0.0002 (2.2 %)** | 9.1e-05 (1 %) |" in table
    assert "| damping of mode 3 | – | – | – |" in table
    assert "About **12 s** more." in table
    assert "Fit of the first 8.0 s" in table
    assert "| 1 | 2.56970 ± 0.00078 | 0.910 ± 0.039 |" in table
    assert "Not visible so far: mode 3." in table
    assert "| zeta | (7.04 ± 0.39)·10⁻⁵ |" in table
    assert "| tool inertia | (0.0 ± 1.2)·10⁻⁶ kg·m² |" in table
    assert "A disturbance at 50 Hz was modelled." in table
    assert "✓" not in table
    assert "✓" in fit_table(online_fit(width=0.9))
    ended = online_fit() | {"search": {"reason": "Reached: it is <so>.", "targets": []}}
    assert r"**Reached: it is \<so\>.**" in fit_table(ended)
    assert "more" not in fit_table(ended)
    none = {"duration_s": 3.0, "problem": "Nothing was excited.", "text": []}
    assert fit_table(none) == "**After 3.0 s:** Nothing was excited."
    assert "doubtful: It depends" in fit_table(online_fit(third="doubtful"))


def test_fitted_sessions_have_two_plots_per_mode(description, layout_of):
    first, *others = [tab.name for tab in layout_of().contents]
    layout = layout_of(replace(description, fitted_mode_count=2))
    assert [tab.name for tab in layout.contents] == [first, "Fit", *others]
    grid, table = layout.contents[1].contents
    assert [view.name for view in grid.contents] == [
        "Damping ratio of mode 1 (%)", "Frequency of mode 1 (Hz)",
        "Damping ratio of mode 2 (%)", "Frequency of mode 2 (Hz)",
    ]  # fmt: skip
    assert table.origin == FIT_TABLE_ENTITY
    (only,) = layout_of(replace(description, fitted_mode_count=0)).contents[1].contents
    assert only.origin == FIT_TABLE_ENTITY


def test_new_connections_get_all_fits(fitted, shown):
    picture = Scene(fitted(2))
    assert (
        shown(picture.initial_drawings())[FIT_TABLE_ENTITY].last("TextDocument:text")
        == "No fit yet."
    )
    picture.fit_drawings(online_fit(6.0, 2.0))
    drawn = picture.fit_drawings(online_fit(8.0))
    for drawings in (drawn, picture.initial_drawings()):
        found = shown(drawings)
        assert found["/fits"].times_ns["damping_2_percent"][-1] == 8_000_000_000
        assert found["/fits"].values["damping_2_percent"][-1][-1] == pytest.approx(0.416)
        assert "Fit of the first 8.0 s" in found[FIT_TABLE_ENTITY].last("TextDocument:text")
    low, high = (np.array(found["/fits"].values["damping_2_percent"])[:, k] for k in (2, 3))
    # From nothing known over a wide interval to a narrow one.
    assert np.isnan(low[0])
    assert (high - low)[1:] == pytest.approx([2 * 2 * 1.96 * 3e-3, 2 * 1.96 * 3e-3])


def test_session_without_fits_draws_none(description, shown):
    picture = Scene(description)
    assert picture.fit_drawings(online_fit()) == []
    assert FIT_TABLE_ENTITY not in shown(picture.initial_drawings())


@pytest.mark.further  # as one that runs
def test_a_recorded_session_shows_the_fit_in_its_file(touch_file, shown, make_timings):
    timings = make_timings(0)
    recorded = read_session(touch_file.path)
    assert FIT_TABLE_ENTITY not in shown([lambda stream: draw_session(stream, recorded, timings)])
    fit = online_fit(1.5) | {"search": {"reason": "Reached.", "pieces": []}}
    session = replace(recorded, outcome={"fit": json.dumps(fit)})
    found = shown([lambda stream: draw_session(stream, session, timings)])
    assert found[FIT_TABLE_ENTITY].last("TextDocument:text").startswith("**Reached.**")
    assert "/fits" not in found

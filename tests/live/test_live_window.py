"""What the operator sees: Rerun's own viewer, without a window, looked at from outside."""

import io
import os
import re
import subprocess

import matplotlib.image
import numpy as np
import pytest

from rigd.view import PLOTS, WINDOW_S

NO_GRAPHICS = "LIVE VIEW NOT TESTED: no graphics adapter for the viewer (mesa-vulkan-drivers?)"


@pytest.fixture
def viewer(rerun_program, publisher, tmp_path, eventually):
    """Rerun's viewer at 1280 × 800, connected to the publisher's server."""
    from rerun.experimental import ViewerClient

    log = tmp_path / "viewer.log"
    with log.open("w") as output:
        process = subprocess.Popen(
            [
                rerun_program,
                *("--connect", publisher.proxy_url),
                "--headless",
                *("--window-size", "1280x800"),
                *("--bind", "127.0.0.1"),
                *("--port", "0"),
            ],
            env={**os.environ, "CI": "1", "NO_COLOR": "1", "RUST_LOG": "info"},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        port = re.compile(r"gRPC connections on 127\.0\.0\.1:(\d+)")
        assert eventually(lambda: process.poll() is not None or port.search(log.read_text()))
        assert eventually(lambda: process.poll() is not None or "running at" in log.read_text())
        if process.poll() is not None:
            if re.search("graphics adapter|wgpu", log.read_text()):
                pytest.skip(NO_GRAPHICS)
            pytest.fail(log.read_text())
        url = f"rerun+http://127.0.0.1:{port.search(log.read_text())[1]}/proxy"
        with ViewerClient.connect(url) as client:
            yield client
    finally:
        process.kill()
        process.wait()


def count(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Return the number of pixels within a few grey levels of a colour."""
    distance = np.abs(image[..., :3] * 255.0 - np.array(color))
    return int(np.count_nonzero(np.all(distance < 12.0, axis=-1)))


def test_every_view_shows_its_curves_as_they_come(viewer, producer, eventually):
    def views():
        return {view.name: view for view in viewer.get_state().views}

    assert eventually(lambda: views().keys() == {plot.title for plot in PLOTS})

    def newest_s() -> float:
        recordings = [r for r in viewer.get_state().recordings if r.timelines]
        return recordings[0].current_time * 1e-9 if recordings else -np.inf

    # It follows the newest sample, as long as the session lasts.
    assert eventually(lambda: producer.tick * 1e-3 - newest_s() < 1.5)
    then = newest_s()
    assert eventually(lambda: newest_s() > then + 0.5)
    assert eventually(lambda: producer.tick * 1e-3 - newest_s() < 1.5)

    for plot in PLOTS:
        view = views()[plot.title]
        assert view.reports == []
        picture = matplotlib.image.imread(io.BytesIO(viewer.take_screenshot(view.view_id)), "png")
        for curve in plot.curves:
            assert count(picture, curve.color) > 100, f"{curve.label} is not to be seen"
    whole = matplotlib.image.imread(io.BytesIO(viewer.take_screenshot()), "png")
    assert whole.shape[:2] == (800, 1280)

    blueprint = viewer.get_blueprint().blueprint
    lines = [entry["SeriesLines"] for entry in blueprint.values() if "SeriesLines" in entry]
    assert len(lines) == len(PLOTS)
    assert all("MinMax" in str(entry["aggregation_policy"]) for entry in lines)
    assert f"{-round(WINDOW_S * 1e9)}" in str(blueprint)

import json

import pytest
import warm_start
from typer.testing import CliRunner

from rigd.cli.app import app
from rigd.runner import ProcessGroup
from rigd.runtime import StopRequest


@pytest.fixture
def patient(write_profile):
    """The simulated rig, for sessions in real time on a machine that may stall."""
    return write_profile("sim", patient=True)


@pytest.fixture(scope="session")
def run_patched(made_once):
    """Run `rigd run` once for all workers, with patched processes that are copies of this one.

    The function returns exit code, standard output and standard error.
    """

    def run(name, command, patches, *extra_processes):
        def make(folder):
            with pytest.MonkeyPatch.context() as patch, warm_start.children_copied():
                for target, value in patches.items():
                    patch.setattr(target, value)
                group = ProcessGroup(with_live_view=False, extra_processes=extra_processes)
                patch.setattr("rigd.cli.run.start_processes", lambda **_: (StopRequest(), group))
                patch.setattr(
                    "rigd.runtime.ignore_end_signals", lambda **_: None
                )  # of the test runner
                done = CliRunner().invoke(app, ["run", *command, "--output", str(folder)])
            printed = [done.exit_code, done.stdout, done.stderr]
            (folder / "told.json").write_text(json.dumps(printed))

        return json.loads((made_once(name, make) / "told.json").read_text())

    return run

"""``rigd bench`` from the command line."""

import json

import pytest
from typer.testing import CliRunner

from rigd.bench import BenchResults
from rigd.cli.app import app
from rigd.errors import FailureError
from rigd.runtime.locks import RigLock


@pytest.fixture
def bench(monkeypatch, measured):
    """The command, with fake results."""
    calls = []

    class FakeBench:
        fails = ""

        def __init__(self, profile, **options):
            calls.append((profile.name, options))
            self.profile = profile

        def run(self):
            if self.fails:
                raise FailureError(self.fails)
            results = BenchResults("sim", 1000.0, 1.0, 0.0, {"cpu": "0"}, (0.5, 0.4, 0.3))
            results.rounds.append((measured(), None))
            results.session_measurements.append(measured())
            results.search_measurements.append(measured())
            return results

    monkeypatch.setattr("rigd.bench.Bench", FakeBench)
    made = CliRunner()

    def run(*arguments):
        return made.invoke(app, ["bench", *arguments])

    run.calls, run.fake_bench = calls, FakeBench
    return run


def test_the_report_ends_with_a_verdict(bench):
    done = bench("--rate", "2000", "--seconds", "5", "--spin-us", "50")
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1].startswith("Simulated devices: this computer held 1000 Hz")
    ((name, options),) = bench.calls
    assert name == "sim"
    assert (options["rate_hz"], options["measurement_duration_s"], options["spin_us"]) == (
        2000.0,
        5.0,
        50.0,
    )


def test_standard_output_is_only_the_document(bench):
    done = bench("--json")
    assert json.loads(done.stdout)["highest_rate_hz"] == 1000.0


def test_a_failure_is_one_sentence(bench):
    bench.fake_bench.fails = "There is no shared memory."
    done = bench()
    assert done.exit_code == 1
    assert "Error: There is no shared memory." in done.stderr
    assert "Traceback" not in done.stderr


def test_bench_is_refused_during_a_session(bench):
    with RigLock("sim", "rigd run", hardware=False):
        done = bench()
    assert done.exit_code == 1
    assert "in use" in done.stderr
    assert not bench.calls


@pytest.mark.parametrize("wrong", [("--rate", "20"), ("--seconds", "0"), ("--profile", "nobody")])
def test_wrong_use_is_refused(bench, wrong):
    done = bench(*wrong)
    assert done.exit_code == 2
    assert not bench.calls

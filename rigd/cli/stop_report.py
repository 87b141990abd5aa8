"""Action and output of ``rigd stop``, in a module that is quick to import."""

import sys
from typing import TYPE_CHECKING

from rigd.cli.entry import EXIT_FAILED, run_command
from rigd.daemon import stop_all

if TYPE_CHECKING:
    from rigd.daemon import StopReport


def main() -> None:
    """Run ``rigd stop`` without options; this does not load the option parser, which is slow."""
    run_command(lambda: sys.exit(stop_and_report(None, is_end_awaited=True)))


def stop_and_report(profile: str | None, *, is_end_awaited: bool) -> int:
    """Stop the running sessions, print the result, and return the exit code.

    Parameters
    ----------
    profile
        Profile of the rig whose sessions are stopped, or None to stop all sessions.
    is_end_awaited
        Whether to wait until the sessions have ended.
    """
    stop_report = stop_all(profile, is_end_awaited=is_end_awaited)
    if profile is not None and not stop_report.has_found_process:
        from rigd.profile import load_profile

        rig_name = load_profile(profile).name
        if rig_name != profile:
            stop_report = stop_all(rig_name, is_end_awaited=is_end_awaited)
    _print_report(stop_report)
    return 0 if stop_report.is_stop_certain else EXIT_FAILED


def _print_report(report: "StopReport") -> None:
    """Print the result of a stop to standard output, and problems to standard error."""
    report_lines = [f"Stopped: {message_text}." for message_text in report.stopped_sessions]
    if report.is_stop_certain and not report.stopping_sessions:
        if len(report.stopped_sessions) == 1:
            report_lines.append("The session has ended; the torque is off.")
        elif report.stopped_sessions:
            report_lines.append(
                f"All {len(report.stopped_sessions)} sessions have ended; the torque is off."
            )
        elif not report.sentences_without_session:
            owner_text = " of yours" if report.sessions_of_others else ""
            report_lines.append(
                f"No session{owner_text} is running. Searched: "
                f"{', '.join(report.searched_locations)}."
            )
    report_lines += [
        f"{message_text} is being stopped." for message_text in report.stopping_sessions
    ]
    report_lines += report.sentences_without_session
    problem_lines = [
        f"Not stopped: {message_text}; only that user or root can stop it."
        for message_text in report.sessions_of_others
    ]
    problem_lines += [
        f"Error: {message_text} was asked to stop, but its session did not end; check rigd status "
        "and the rig, and press the wired stop (STO) if anything moves."
        for message_text in report.unended_sessions
    ]
    problem_lines += [
        f"Error: {message_text} Press the wired stop (STO)."
        for message_text in report.unconfirmed_drives
    ]
    problem_lines += [f"Error: {message_text}" for message_text in report.doubts]
    if report.doubts and not report.unended_sessions:
        problem_lines.append(
            "Whether another session runs is not known: check the rig, and press the wired stop "
            "(STO) if anything moves."
        )
    for message_texts, output_stream in ((report_lines, sys.stdout), (problem_lines, sys.stderr)):
        if message_texts:
            output_stream.write("".join(f"{message_text}\n" for message_text in message_texts))
            output_stream.flush()

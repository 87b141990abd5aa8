"""Request and output of ``rigd status``, in a module that is quick to import."""

import json
import sys
from typing import Any

from rigd.cli.entry import EXIT_FAILED, EXIT_WRONG_USE, run_command
from rigd.daemon.address import find_daemon_socket
from rigd.daemon.client import Client
from rigd.errors import RigdError
from rigd.printable import readable_message


def main() -> None:
    """Run ``rigd status`` without options; this does not load the option parser, which is slow."""
    run_command(_request_and_report)


def _request_and_report() -> None:
    """Print the status of the only running daemon."""
    try:
        with Client(find_daemon_socket(None)) as client:
            daemon_reply = client.ask("status")
    except RigdError as error:
        sys.stderr.write(f"Error: {readable_message(error.full_message())}\n")
        sys.exit(EXIT_WRONG_USE if error.wrong_use else EXIT_FAILED)
    report_status(daemon_reply, as_json="--json" in sys.argv)


def report_status(daemon_reply: dict[str, Any], *, as_json: bool) -> None:
    """Print a daemon's reply to the request ``status`` as a table or as a JSON document."""
    if as_json:
        del daemon_reply["reply"], daemon_reply["ok"]
        sys.stdout.write(f"{json.dumps(daemon_reply)}\n")
        sys.stdout.flush()
        return
    from rigd.cli.status_view import print_status

    print_status(daemon_reply)

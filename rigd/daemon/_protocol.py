"""Requests to the daemon: a line of bytes is parsed into a checked request, or refused.

The input is untrusted. A refusal names the error; docs/control_socket.md has the rules.
"""

import inspect
import json
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from rigd.errors import RigdError
from rigd.excitation import FROM_THE_RIG, KINDS, Value
from rigd.session.user_metadata import NOTES, MetadataError, metadata_keys
from rigd.units import finite_number

LONGEST_LINE = 65_536
"""Limit in bytes of a request with its newline."""
MOST_SESSIONS = 1000
_LONGEST_PATH = 4096
_LONGEST_TEXT = 1000
_SHOWN = 60

_LONGEST_ID = 64
_MOST_ROWS = 32
Note = Annotated[str, Field(max_length=1000)]
RowName = Annotated[str, Field(max_length=_LONGEST_ID)]
Id = int | Annotated[str, Field(max_length=_LONGEST_ID)]


class RequestError(Exception):
    """A request is invalid; the message says why, and `request_id` identifies the request."""

    def __init__(self, message: str, request_id: Id | None = None) -> None:
        super().__init__(message)
        self.request_id = request_id


class CommandError(RigdError):
    """A request is refused or failed; the message is for the operator."""

    def __init__(self, message: str, *, wrong_use: bool = False) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use
        """Whether the request itself must change."""


class Request(BaseModel):
    """Base of all requests, with their common fields."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    controlling: ClassVar[bool] = False
    """Whether only the client that holds control may send it."""

    command: str
    id: Id | None = None


class StatusRequest(Request):
    """Report the status of daemon, rig and session."""

    command: Literal["status"]


class WatchRequest(Request):
    """Subscribe to the events."""

    command: Literal["watch"]
    signals: bool = False


class StopSessionRequest(Request):
    """End the running session safely."""

    command: Literal["stop"]


class TareRequest(Request):
    """Average the sensor at rest."""

    controlling = True
    command: Literal["tare"]


class ZeroRequest(Request):
    """Make the present angle the zero."""

    controlling = True
    command: Literal["zero"]


class ResetRequest(Request):
    """Leave the fault."""

    controlling = True
    command: Literal["reset"]


class Notes(BaseModel):
    """Notes of the operator for the session files."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    operator: Note = ""
    specimen: Note = ""
    note: Note = ""
    meta: dict[str, Any] = {}

    def as_metadata(self) -> dict[str, str]:
        """Return the notes that are set, by their keys in the session file.

        Raises
        ------
        MetadataError
            If added metadata breaks a rule.
        """
        texts = {name: getattr(self, name) for name in NOTES}
        return {name: text for name, text in texts.items() if text} | metadata_keys(self.meta)


class CheckRequest(Request):
    """Check profile, control loop, computer, and the data that the connected devices reported."""

    controlling = True
    command: Literal["check"]


class SessionRequest(Request):
    """A session or a series of sessions."""

    excitation: str
    parameters: dict[str, Any] = {}
    repeat: int = Field(default=1, ge=1, le=MOST_SESSIONS)
    notes: Notes = Notes()
    force: bool = False
    watch_fit: bool = False
    accept: list[RowName] = Field(default=[], max_length=_MOST_ROWS)
    tip_slope_rad: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)


class StartRequest(SessionRequest):
    """Run the sessions."""

    controlling = True
    command: Literal["start"]


class PredictRequest(SessionRequest):
    """Predict the sessions without running them."""

    command: Literal["predict"]


AnyRequest = (
    StatusRequest
    | WatchRequest
    | StopSessionRequest
    | TareRequest
    | ZeroRequest
    | ResetRequest
    | CheckRequest
    | StartRequest
    | PredictRequest
)
_REQUESTS: TypeAdapter[AnyRequest] = TypeAdapter(
    Annotated[AnyRequest, Field(discriminator="command")]
)
_COMMANDS = "status", "watch", "stop", "tare", "zero", "reset", "check", "start", "predict"


def parse_request(line: bytes) -> AnyRequest:
    """Return the request in a line.

    Raises
    ------
    RequestError
        If it is invalid; the message names the error.
    """
    given = _parse_object(line)
    request_id = given.get("id")
    if not isinstance(request_id, int | str) or isinstance(request_id, bool):
        request_id = None
    command = given.get("command")
    if command not in _COMMANDS:
        raise RequestError(
            f"command = {_shown(command)} is unknown; choose {', '.join(_COMMANDS)}.",
            request_id,
        )
    try:
        request = _REQUESTS.validate_python(given)
    except ValidationError as error:
        raise RequestError(_first_complaint(error), request_id) from None
    try:
        return _checked(request) if isinstance(request, SessionRequest) else request
    except RequestError as error:
        raise RequestError(str(error), request_id) from None


def _parse_object(line: bytes) -> dict[str, Any]:
    try:
        given = json.loads(line.decode(), parse_constant=_no_constant)
    except UnicodeDecodeError:
        raise RequestError("The line is not UTF-8.") from None
    except RecursionError:
        raise RequestError("The line is nested too deeply.") from None
    except ValueError as error:
        raise RequestError(f"The line is not JSON ({error}).") from None
    if not isinstance(given, dict):
        raise RequestError("A request is a JSON object.")
    return given


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _first_complaint(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False)[0]
    if first["loc"][1:2] == ("id",):  # pydantic reports each of its two types separately
        return f"id is a whole number or a text of at most {_LONGEST_ID} characters."
    where = ".".join(str(part)[:_SHOWN] for part in first["loc"][1:]) or "The request"
    return f"{where}: {first['msg']}."


AnySessionRequest = TypeVar("AnySessionRequest", bound=SessionRequest)


def _checked(request: AnySessionRequest) -> AnySessionRequest:
    """Return a session request whose parameters fit the excitation's function."""
    if request.excitation not in KINDS:
        raise RequestError(
            f"excitation = {_shown(request.excitation)} is unknown; choose {', '.join(KINDS)}."
        )
    for note in NOTES:
        if not getattr(request.notes, note).isprintable():
            raise RequestError(f"notes.{note} is not plain text of one line.")
    try:
        request.notes.as_metadata()
    except MetadataError as error:
        raise RequestError(f"notes.meta: {error}") from None
    update: dict[str, Any] = {}
    given_parameters = dict(request.parameters)
    # Older clients send it among the parameters of `until`.
    if request.tip_slope_rad is None and "tip_slope_rad" in given_parameters:
        slope_rad = _number("tip_slope_rad", given_parameters.pop("tip_slope_rad"))
        if slope_rad <= 0.0:
            raise RequestError(f"tip_slope_rad = {slope_rad:g} rad must be more than 0 rad.")
        update["tip_slope_rad"] = slope_rad
    function = KINDS[request.excitation]
    known = {
        name: parameter
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in FROM_THE_RIG
    }
    values: dict[str, Value] = {}
    for name, given in given_parameters.items():
        if name not in known:
            raise RequestError(
                f"parameters: {_shown(name)} is not a parameter of {request.excitation}; there are "
                f"{', '.join(known)}."
            )
        values[name] = _value(name, given, known[name].annotation)
    for name, parameter in known.items():
        if parameter.default is inspect.Parameter.empty and name not in values:
            raise RequestError(f"parameters.{name} is missing.")
    return request.model_copy(update={**update, "parameters": values})


def _value(name: str, given: object, wanted: object) -> Value:
    if wanted in (float, float | None):
        return _number(name, given)
    if wanted is int:
        if isinstance(given, int) and not isinstance(given, bool) and abs(given) < 2**63:
            return given
        raise RequestError(f"parameters.{name} = {_shown(given)} is not a whole number.")
    if wanted is str:
        if isinstance(given, str) and given.isprintable() and len(given) <= _LONGEST_TEXT:
            return given
        raise RequestError(
            f"parameters.{name} = {_shown(given)} is not plain text of one line and at most "
            f"{_LONGEST_TEXT} characters."
        )
    if (
        isinstance(given, str)
        and given.isprintable()
        and len(given) < _LONGEST_PATH
        and Path(given).is_absolute()
    ):
        return Path(given)
    raise RequestError(
        f"parameters.{name} = {_shown(given)} is not the absolute path of a file; give one that "
        "the daemon can read."
    )


def _number(name: str, given: object) -> float:
    number = finite_number(given)
    if number is None:
        raise RequestError(f"parameters.{name} = {_shown(given)} is not a finite number.")
    return number


def _shown(value: object) -> str:
    """Return a value as JSON, shortened for a message."""
    try:
        text = json.dumps(value)
    except (ValueError, RecursionError):
        text = "..."
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."

"""Requests to the daemon: parsing and validation of lines of untrusted bytes.

An invalid line raises an error whose text states the reason. docs/control_socket.md describes the
requests.
"""

import json
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from rigd.errors import RigdError
from rigd.excitation import KINDS, OptionValue, excitation_options
from rigd.session.user_metadata import NOTES, MetadataError, metadata_keys
from rigd.units import finite_number

MAX_LINE_BYTES = 65_536
"""Maximum length of a request in bytes, including its newline."""
MAX_SESSIONS = 1000
"""Maximum number of sessions in a series."""
_MAX_PATH_CHARACTERS = 4096
"""Maximum number of characters of a path among the parameters."""
_MAX_TEXT_CHARACTERS = 1000
"""Maximum number of characters of a text among the parameters."""
_MAX_SHOWN_VALUE_CHARACTERS = 60
"""Maximum number of characters of a value in an error message."""

_MAX_ID_CHARACTERS = 64
"""Maximum number of characters of a request's id or of a row's name."""
_MAX_ACCEPTED_ROWS = 32
"""Maximum number of checks that a request may accept as failed."""
Note = Annotated[str, Field(max_length=1000)]
RowName = Annotated[str, Field(max_length=_MAX_ID_CHARACTERS)]
RequestId = int | Annotated[str, Field(max_length=_MAX_ID_CHARACTERS)]


class RequestError(Exception):
    """Raised if a request is invalid; the message states why, and `request_id` which request."""

    def __init__(self, message: str, request_id: RequestId | None = None) -> None:
        super().__init__(message)
        self.request_id = request_id


class CommandError(RigdError):
    """Raised if a request is refused or has failed; the message is for the operator."""

    def __init__(self, message: str, *, wrong_use: bool = False) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use
        """Whether the request can succeed only if it is changed."""


class Request(BaseModel):
    """Base class of all requests, with their common fields."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    is_controlling: ClassVar[bool] = False
    """Whether only the client that controls the rig may send the request."""

    command: str
    id: RequestId | None = None


class StatusRequest(Request):
    """Request for the status of daemon, rig and session."""

    command: Literal["status"]


class WatchRequest(Request):
    """Request to subscribe to the daemon's events, and to the rig's signals if `signals`."""

    command: Literal["watch"]
    signals: bool = False


class StopSessionRequest(Request):
    """Request to end the running session safely."""

    command: Literal["stop"]


class TareRequest(Request):
    """Request to tare the force-torque sensor: its mean reading at rest becomes zero."""

    is_controlling = True
    command: Literal["tare"]


class ZeroRequest(Request):
    """Request to set the present motor angle as the rig's zero."""

    is_controlling = True
    command: Literal["zero"]


class ResetRequest(Request):
    """Request to reset a fault of the rig."""

    is_controlling = True
    command: Literal["reset"]


class Notes(BaseModel):
    """Operator, specimen, note and other metadata of the user for the session files."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    operator: Note = ""
    specimen: Note = ""
    note: Note = ""
    meta: dict[str, Any] = {}

    def as_metadata(self) -> dict[str, str]:
        """Return the notes that are not empty: key in the session file → text.

        Raise `MetadataError` if a name or value of `meta` breaks a rule.
        """
        note_texts = {metadata_name: getattr(self, metadata_name) for metadata_name in NOTES}
        return {
            metadata_name: metadata_text
            for metadata_name, metadata_text in note_texts.items()
            if metadata_text
        } | metadata_keys(self.meta)


class CheckRequest(Request):
    """Request to check profile, control loop, computer, and data that the devices have reported."""

    is_controlling = True
    command: Literal["check"]


class SessionRequest(Request):
    """Base class of requests that describe a session or a series of sessions."""

    excitation: str
    parameters: dict[str, Any] = {}
    repeat: int = Field(default=1, ge=1, le=MAX_SESSIONS)
    notes: Notes = Notes()
    force: bool = False
    watch_fit: bool = False
    accept: list[RowName] = Field(default=[], max_length=_MAX_ACCEPTED_ROWS)
    tip_slope_rad: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)


class StartRequest(SessionRequest):
    """Request to run a session or a series of sessions."""

    is_controlling = True
    command: Literal["start"]


class PredictRequest(SessionRequest):
    """Request to predict a session without running it."""

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
_REQUEST_VALIDATOR: TypeAdapter[AnyRequest] = TypeAdapter(
    Annotated[AnyRequest, Field(discriminator="command")]
)
_COMMAND_NAMES = "status", "watch", "stop", "tare", "zero", "reset", "check", "start", "predict"


def parse_request(request_line: bytes) -> AnyRequest:
    """Return the request that a line of bytes contains.

    Raise `RequestError` if the line is not a valid request; the message states the reason.
    """
    request_document = _parse_object(request_line)
    request_id = request_document.get("id")
    if not isinstance(request_id, int | str) or isinstance(request_id, bool):
        request_id = None
    command_name = request_document.get("command")
    if command_name not in _COMMAND_NAMES:
        raise RequestError(
            f"command = {_shown_value(command_name)} is unknown; choose "
            f"{', '.join(_COMMAND_NAMES)}.",
            request_id,
        )
    try:
        parsed_request = _REQUEST_VALIDATOR.validate_python(request_document)
    except ValidationError as error:
        raise RequestError(_first_error_sentence(error), request_id) from None
    try:
        return (
            _checked_session_request(parsed_request)
            if isinstance(parsed_request, SessionRequest)
            else parsed_request
        )
    except RequestError as error:
        raise RequestError(str(error), request_id) from None


def _parse_object(json_line: bytes) -> dict[str, Any]:
    """Return the JSON object in a line; raise RequestError if there is none."""
    try:
        json_object = json.loads(json_line.decode(), parse_constant=_refuse_json_constant)
    except UnicodeDecodeError:
        raise RequestError("The line is not UTF-8.") from None
    except RecursionError:
        raise RequestError("The line is nested too deeply.") from None
    except ValueError as error:
        raise RequestError(f"The line is not JSON ({error}).") from None
    if not isinstance(json_object, dict):
        raise RequestError("A request is a JSON object.")
    return json_object


def _refuse_json_constant(constant_name: str) -> NoReturn:
    """Raise ValueError for ``NaN`` or ``Infinity`` in a line of JSON."""
    raise ValueError(f"{constant_name} is not a number")


def _first_error_sentence(error: ValidationError) -> str:
    """Return a sentence on the first invalid field of a request."""
    first_error = error.errors(include_url=False, include_context=False)[0]
    if first_error["loc"][1:2] == ("id",):  # pydantic reports each of its two types separately
        return f"id is a whole number or a text of at most {_MAX_ID_CHARACTERS} characters."
    field_name = (
        ".".join(
            str(location_part)[:_MAX_SHOWN_VALUE_CHARACTERS]
            for location_part in first_error["loc"][1:]
        )
        or "The request"
    )
    return f"{field_name}: {first_error['msg']}."


AnySessionRequest = TypeVar("AnySessionRequest", bound=SessionRequest)


def _checked_session_request(request: AnySessionRequest) -> AnySessionRequest:
    """Return a session request after its parameters were checked and converted to their types.

    Raises RequestError if the excitation, a note or a parameter is invalid.
    """
    if request.excitation not in KINDS:
        raise RequestError(
            f"excitation = {_shown_value(request.excitation)} is unknown; choose "
            f"{', '.join(KINDS)}."
        )
    for note_text in NOTES:
        if not getattr(request.notes, note_text).isprintable():
            raise RequestError(f"notes.{note_text} is not plain text of one line.")
    try:
        request.notes.as_metadata()
    except MetadataError as error:
        raise RequestError(f"notes.meta: {error}") from None
    checked_fields: dict[str, Any] = {}
    given_parameters = dict(request.parameters)
    # Older clients send it among the parameters of `until`.
    if request.tip_slope_rad is None and "tip_slope_rad" in given_parameters:
        tip_slope_rad = _finite_number("tip_slope_rad", given_parameters.pop("tip_slope_rad"))
        if tip_slope_rad <= 0.0:
            raise RequestError(f"tip_slope_rad = {tip_slope_rad:g} rad must be more than 0 rad.")
        checked_fields["tip_slope_rad"] = tip_slope_rad
    option_by_name = {option.name: option for option in excitation_options(request.excitation)}
    checked_values: dict[str, OptionValue] = {}
    for parameter_name, given_value in given_parameters.items():
        if parameter_name not in option_by_name:
            raise RequestError(
                f"parameters: {_shown_value(parameter_name)} is not a parameter of "
                f"{request.excitation}; choose from {', '.join(option_by_name)}."
            )
        checked_values[parameter_name] = _converted_parameter(
            parameter_name, given_value, option_by_name[parameter_name].value_type
        )
    for option in option_by_name.values():
        if option.required and option.name not in checked_values:
            raise RequestError(f"parameters.{option.name} is missing.")
    return request.model_copy(update={**checked_fields, "parameters": checked_values})


def _converted_parameter(
    parameter_name: str, given_value: object, wanted_type: object
) -> OptionValue:
    """Return a parameter converted to the type `wanted_type`; raise RequestError if impossible."""
    if wanted_type in (float, float | None):
        return _finite_number(parameter_name, given_value)
    if wanted_type is int:
        if (
            isinstance(given_value, int)
            and not isinstance(given_value, bool)
            and abs(given_value) < 2**63
        ):
            return given_value
        raise RequestError(
            f"parameters.{parameter_name} = {_shown_value(given_value)} is not a whole number."
        )
    if wanted_type is str:
        if (
            isinstance(given_value, str)
            and given_value.isprintable()
            and len(given_value) <= _MAX_TEXT_CHARACTERS
        ):
            return given_value
        raise RequestError(
            f"parameters.{parameter_name} = {_shown_value(given_value)} is not plain text of one "
            f"line and at most {_MAX_TEXT_CHARACTERS} characters."
        )
    if (
        isinstance(given_value, str)
        and given_value.isprintable()
        and len(given_value) < _MAX_PATH_CHARACTERS
        and Path(given_value).is_absolute()
    ):
        return Path(given_value)
    raise RequestError(
        f"parameters.{parameter_name} = {_shown_value(given_value)} is not the absolute path of "
        "a file; give one that the daemon can read."
    )


def _finite_number(parameter_name: str, given_value: object) -> float:
    """Return a parameter as a finite number; raise RequestError if it is not one."""
    finite_value = finite_number(given_value)
    if finite_value is None:
        raise RequestError(
            f"parameters.{parameter_name} = {_shown_value(given_value)} is not a finite number."
        )
    return finite_value


def _shown_value(json_value: object) -> str:
    """Return a value as JSON text for an error message, cut to 60 characters."""
    try:
        json_text = json.dumps(json_value)
    except (ValueError, RecursionError):
        json_text = "..."
    return (
        json_text
        if len(json_text) <= _MAX_SHOWN_VALUE_CHARACTERS
        else f"{json_text[:_MAX_SHOWN_VALUE_CHARACTERS]}..."
    )

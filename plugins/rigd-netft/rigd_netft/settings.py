"""Section ``[netft]`` of a profile."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MinLen, doc

from rigd_netft.protocol import RDT_PORT, CutOffHz


@dataclass(frozen=True, slots=True)
class NetFtSettings:
    """Settings of a Net F/T box; the texts in the types are the help."""

    host: Annotated[str, MinLen(1), doc("address of the box, such as 192.168.1.1")]
    rate_hz: Annotated[
        float, Gt(0), Le(7000), doc("records per second: 7000 over a whole number")
    ] = 7000.0
    filter_hz: Annotated[CutOffHz, doc("cut-off of the box's low-pass filter; 0: none")] = 0
    bias: Annotated[
        Literal["keep", "zero"], doc("whether the box keeps its bias or it is set to zero")
    ] = "keep"
    tool_transform: Annotated[
        tuple[float, float, float, float, float, float],
        doc("tool transformation of the box, in its units; the box must have the same"),
    ] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    serial_number: Annotated[str, doc("serial number that the sensor must report; empty: any")] = ""
    counts_per_n: Annotated[
        float, Ge(0), doc("counts per N of a box without web page; 0: read from the page")
    ] = 0.0
    counts_per_nm: Annotated[
        float, Ge(0), doc("counts per N·m of a box without web page; 0: read from the page")
    ] = 0.0
    port: Annotated[int, Ge(1), Le(65535), doc("UDP port of the box")] = RDT_PORT
    http_port: Annotated[int, Ge(1), Le(65535), doc("port of the web page")] = 80
    faults: Annotated[
        tuple[str, ...], doc("faults of a simulated box, such as loss=0.01 or silence@2")
    ] = ()

    @property
    def box_name(self) -> str:
        """Name of the box in messages, with its address."""
        return f"Net F/T box at {self.host}"

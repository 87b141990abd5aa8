"""Tests of drawings by Rerun's viewer, on computers where it cannot draw."""

import re
from typing import NoReturn, Protocol

import pytest

_WITHOUT_GRAPHICS = re.compile(
    "[Nn]o (suitable )?(graphics|wgpu) adapter|Failed to get render context"
)
NO_GRAPHICS = "LIVE VIEW NOT TESTED: no Vulkan driver for the viewer (package mesa-vulkan-drivers)"


class ControlEnded(Protocol):
    """A viewer that has ended."""

    @property
    def without_graphics(self) -> bool: ...

    @property
    def last_log_lines(self) -> str: ...


def viewer_ended(viewer: ControlEnded) -> NoReturn:
    """End a test whose viewer has: skipped if the computer lacks graphics, failed otherwise."""
    if viewer.lacks_graphics:
        pytest.skip(NO_GRAPHICS)
    pytest.fail(viewer.last_log_lines)


def viewer_ended_with_log(log: str) -> NoReturn:
    """End a test by the log of a viewer that has ended: skipped or failed, as above."""
    if _WITHOUT_GRAPHICS.search(log):
        pytest.skip(NO_GRAPHICS)
    pytest.fail(log)

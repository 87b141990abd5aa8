"""A command that may begin with a subcommand's name, and is a command of its own otherwise."""

from __future__ import annotations

from typing import Any, Final

from typer.core import TyperGroup

DEFAULT: Final = "default"
"""Name under which the command is registered that takes all other arguments."""


class DefaultCommandGroup(TyperGroup):
    """A group in which a first argument that names no subcommand goes to the default command.

    The default command stands in the group's place from the parsing on, so its usage, help and
    errors are those of a command without subcommands.
    """

    # Typer's click is its own in some versions and the package of that name in others, so there is
    # no one type of context to name.
    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: Any = None,  # noqa: ANN401
        **extra: Any,  # noqa: ANN401
    ) -> Any:  # noqa: ANN401
        """Parse the arguments for the subcommand named first, or for the default command."""
        if args and args[0] in self.commands and args[0] != DEFAULT:
            return super().make_context(info_name, args, parent, **extra)
        return self.commands[DEFAULT].make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401
        """Run what `make_context` has parsed the arguments for."""
        return super().invoke(ctx) if ctx.command is self else ctx.command.invoke(ctx)

"""Click classes: a group that suggests names for mistyped commands, and the command run with its long help."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import click

from processor.model import did_you_mean

# As of processor.jobs.exit_codes.
EXIT_CODES = (
    (0, "done"),
    (1, "done in part: a step, a scan or an input failed; standard error has the reason"),
    (2, "wrong usage"),
    (3, "bad input, or a limit of time or memory ended the run"),
    (4, "an accuracy limit was missed (of an input with its truth)"),
    (5, "a verdict that --fail-on names"),
)
EXAMPLES = (
    ("processor run my-frame -o results", "a scan folder, the steps of its kind"),
    ("processor run target.e57 --steps spheres --fail-on fail", "one scan file, one step, for a script"),
)


class Suggesting(click.Group):
    """A group that names the command that is most like one that is not known."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the arguments name."""
        name = args[0] if args else ""
        if name and not name.startswith("-") and name not in self.commands:
            like = did_you_mean(name, self.commands)
            raise click.UsageError(f"no command {name!r}{like}; there are {', '.join(sorted(self.commands))}", ctx)
        return super().resolve_command(ctx, args)


class RunCommand(click.Command):
    """The command ``run``, whose help lists steps with their methods, standards, examples and exit codes."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what is listed."""
        from processor.limits import standards

        steps = [
            (name, ", ".join(methods))
            for name, methods in sorted(map(_named, Path(__file__).parents[1].glob("*/step.py")))
        ]
        lists = (
            ("Steps, and their methods (the first is the default)", steps),
            ("Standards, for [tolerance] of project.toml", [(", ".join(standards.standards()), "")]),
            ("Examples", list(EXAMPLES)),
            ("Exit codes", [(str(code), meaning) for code, meaning in EXIT_CODES]),
        )
        for heading, rows in lists:
            with formatter.section(heading):
                if len(rows) == 1:
                    formatter.write_text(rows[0][0])
                else:
                    formatter.write_dl(rows)


def _named(step_file: Path) -> tuple[str, tuple[str, ...]]:
    """Return name and methods of a step, by its sources: to import all steps takes over a second."""
    values = {"NAME": "", "METHODS": ()}
    for file in (step_file, step_file.with_name("params.py")):
        for node in ast.parse(file.read_text("utf-8")).body if file.is_file() else ():
            if isinstance(node, ast.Assign) and (name := ast.unparse(node.targets[0])) in values:
                try:
                    values[name] = ast.literal_eval(node.value)
                except ValueError:  # not written out
                    values[name] = getattr(importlib.import_module(f"processor.{step_file.parent.name}.params"), name)
    return str(values["NAME"]), tuple(values["METHODS"])

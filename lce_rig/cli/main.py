"""`lce-rig`: load subcommands when called, and turn errors into exit codes."""

import importlib
import os
import sys
import traceback
from typing import Any

import click

from lce_rig import __version__
from lce_rig.cli.entry import main
from lce_rig.core.errors import LceRigError
from lce_rig.core.interrupts import EXIT_INTERRUPTED, INTERRUPTED

__all__ = ["COMMANDS", "main", "run"]

# Subcommand -> (module with a click command of that name, help line). Modules are imported when the command
# runs, so that `lce-rig --help` starts instantly.
COMMANDS: dict[str, tuple[str, str]] = {
    "rigs": ("lce_rig.cli.rigs", "List, show, check and derive rig profiles."),
    "board": ("lce_rig.cli.rigs", "Draw a board to print at scale, with its profile block."),
    "doctor": ("lce_rig.cli.doctor", "Check whether this computer and the sensors are fit to collect."),
    "simulate": ("lce_rig.cli.simulate", "Simulate a session or recording of a rig, with exact truth."),
    "collect": ("lce_rig.cli.collect", "Build a session, live and guided, or from recordings."),
    "reconstruct": ("lce_rig.cli.reconstruct", "Reconstruct images from the events of a recording."),
    "captures": ("lce_rig.cli.contents", "List the captures of a session; reject or restore some."),
    "check": ("lce_rig.cli.check", "Report the detections in each capture, or the cause of refusal."),
    "calibrate": ("lce_rig.cli.calibrate", "Estimate the extrinsics of a session."),
    "intrinsics": ("lce_rig.cli.intrinsics", "Estimate the cameras' intrinsics from a session."),
    "lidar-intrinsics": ("lce_rig.cli.intrinsics", "Estimate a LiDAR's constant errors from sessions."),
    "verify": ("lce_rig.cli.verify", "Project the point clouds into the images and print residuals."),
    "view": ("lce_rig.cli.verify", "Show the coloured point cloud and the cameras in 3D."),
    "drift": ("lce_rig.cli.drift", "Check without a board whether extrinsics still hold."),
    "results": ("lce_rig.cli.contents", "List the results of a session with figures and verdicts."),
    "export": ("lce_rig.cli.export", "Write a result for other programs, or into a robot's URDF."),
    "deploy": ("lce_rig.cli.deploy", "Deploy a result to a robot, query its state, or roll back."),
    "repeat": ("lce_rig.cli.contents", "Compare the calibrations of sessions, or the results of one."),
    "fleet": ("lce_rig.cli.fleet", "Calibrate the sessions of many robots; keep and query results."),
}
EXIT_BUG = 70

EPILOG = """\b
Exit codes: 0 done · 1 other error · 2 usage · 3 rig profile · 4 session ·
5 recording, sensor or missing dependency · 6 not enough data ·
7 result refused · 8 target not reached or written, earlier files in place ·
9 command after a deployment failed, new files in place · 70 bug in lce-rig · 130 interrupted
"""


class LateGroup(click.Group):
    """A group that imports a command only when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the subcommands in the order of the work."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the verb's module."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(
            importlib.import_module(COMMANDS[cmd_name][0]), cmd_name.replace("-", "_")
        )
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of subcommands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Suggest the nearest subcommand for one that does not exist."""
        import difflib

        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f" The nearest is '{near[0]}'." if near else ""
            raise click.UsageError(f"No such command '{args[0]}'.{hint}", ctx)
        return super().resolve_command(ctx, args)


@click.group(
    cls=LateGroup,
    epilog=EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="lce-rig", message="%(prog)s %(version)s")
@click.option("--debug", is_flag=True, help="Print the traceback of an error.")
def cli(debug: bool) -> None:
    """Estimate the extrinsics between a LiDAR and frame or event cameras with a checkerboard.

    \b
    A first calibration:
      lce-rig collect --rig rlfs --from recording/   build session/
      lce-rig check                                  report the detections in each capture
      lce-rig calibrate                              write the extrinsics to session/calibration/
      lce-rig verify                                 write images to session/calibration/overlays/
    """


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit code.

    Args:
        arguments: the words after `lce-rig`.
    """
    show_traceback = "--debug" in arguments or bool(os.environ.get("LCE_RIG_DEBUG"))
    try:
        result: Any = cli.main(args=arguments, prog_name="lce-rig", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except BrokenPipeError:
        # The reader of our output has closed the pipe (`lce-rig check | head`).
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
        return 0
    except (Exception, KeyboardInterrupt) as error:
        # Ctrl-C may have stopped the import of a compiled module (open3d).
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, KeyboardInterrupt | click.Abort):
            cause = cause.__cause__
        if cause is not None:
            click.echo(INTERRUPTED, err=True)
            return EXIT_INTERRUPTED
        return _report(error, show_traceback=show_traceback)


def _report(error: BaseException, *, show_traceback: bool) -> int:
    """Print an error and its hint; return the exit code."""
    from lce_rig.cli import show

    what, hint, code = str(error), "", LceRigError.exit_code
    if isinstance(error, LceRigError):
        what, hint, code = error.what, error.hint, error.exit_code
    elif isinstance(error, ModuleNotFoundError):
        what, hint, code = (
            f"the package '{error.name}' is missing",
            "Install it with the others: pip install lce-rig, for `fleet` pip install 'lce-rig[fleet]'",
            5,
        )
        show_traceback |= (error.name or "").startswith("lce_rig")
    elif isinstance(error, MemoryError):
        what = str(error) or "more memory is needed than is free"
    elif not isinstance(error, OSError):
        traceback.print_exception(error)
        click.secho("this is a bug in lce-rig: report it with these lines", fg="red", err=True)
        return EXIT_BUG
    if show_traceback:
        traceback.print_exception(error)
    click.secho(show.wrapped(f"error: {show.harmless(what)}", sys.stderr), fg="red", err=True)
    for line in hint.splitlines():
        show.note(f"  {line}")
    return code

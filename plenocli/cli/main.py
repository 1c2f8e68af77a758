"""Entry point: the list of commands in the order of the pipeline, and the only place where
errors become exit codes.
"""

import errno
import gc
import io
import os
import sys
import time
from functools import partial

import click

from plenocli import __version__
from plenocli.base.budget import within
from plenocli.base.errors import PlenoError
from plenocli.base.memory import is_lack_of_memory, lack_of_memory, limits_restored, require_start
from plenocli.base.progress import tell
from plenocli.cli.commands import COMMANDS, load_command

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class Pipeline(click.Group):
    """A group whose commands are imported when they are asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Their names, in the order of the pipeline."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """The command, imported; None where there is none of that name."""
        if name not in COMMANDS:
            return None
        return load_command(name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does; a misspelt name is answered with the nearest one."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            import difflib

            near = difflib.get_close_matches(args[0], COMMANDS, 1)
            hint = f"Did you mean {near[0]}?" if near else f"Choose one of {', '.join(COMMANDS)}."
            raise click.UsageError(f"No such command {args[0]!r}. {hint}", ctx)
        return super().resolve_command(ctx, args)


@click.group(
    cls=Pipeline,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog=(
        "Exit codes: 0 done; 2 usage or configuration; 3 an input file is unreadable, damaged or "
        "of the wrong kind; 4 the output could not be written; 5 numerically impossible or "
        "accuracy unreachable; 70 a bug of plenocli."
    ),
)
@click.version_option(__version__, prog_name="plenocli")
@click.option(
    "-q", "--quiet", is_flag=True, help="No progress and no notes; errors and results only."
)
@click.option(
    "-v", "--verbose", is_flag=True, help="Also say what a command cost: time and memory."
)
@click.pass_context
def cli(ctx: click.Context, quiet: bool, verbose: bool) -> None:
    """Model a plenoptic camera end to end: from its description and a scene to captures,
    spectra and images.

    \b
    camera.toml --simulate-pif--> pif.h5 --capture-sim--> capture.h5|exr|dng
      RAW or simulated captures --calibrate--> calibration.h5 --demux--> spectra.exr
          --score--> score.json
      photographs --learn-dict--> dictionary.h5 --reconstruct--> image.exr --score--> report.html

    Every command has --help with examples. Lengths carry their unit: 550nm, "250 um", 50mm.
    """
    from plenocli.base import progress

    ctx.with_resource(progress.hushed(quiet))
    if verbose:
        ctx.call_on_close(partial(_cost, time.monotonic()))
    if ctx.invoked_subcommand is None:
        from plenocli.stages.next_step import next_step

        tell(f"{ctx.get_help()}\n\nNext: {next_step('.')}")


def _cost(start: float) -> None:
    import resource

    if "plenocli.files.outside" in sys.modules:
        sys.modules["plenocli.files.outside"].close()
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    seconds, peak = (
        sum(u.ru_utime + u.ru_stime for u in used),
        max(u.ru_maxrss for u in used) / 2**20,
    )
    tell(
        (
            f"plenocli: {time.monotonic() - start:.2f} s, {seconds:.2f} s of processor time, at "
            f"most {peak:.2f} GiB of memory"
        ),
        error=True,
    )


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit; every expected failure is one message on stderr
    and its exit code.
    """
    try:
        sys.exit(run(argv))
    finally:
        # or a process that ends looks through all it has for garbage, three times; what OpenImageIO
        # misses then it tells on stderr
        if "OpenImageIO" not in sys.modules:
            gc.freeze()


def run(argv: list[str] | None = None) -> int:
    """Run the command line with `argv` (default: the process's own) and return the exit code."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # to look for them takes 10 ms
    gc.set_threshold(100_000)  # imports leave no garbage; looking is a twentieth of a start
    debug = os.environ.get("PLENOCLI_DEBUG", "") not in ("", "0")
    stdout = sys.stdout
    try:
        with limits_restored(), within():
            require_start()
            code = cli.main(args=argv, prog_name="plenocli", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except SystemExit:
        if sys.stdout is not stdout:  # click's way to end where nobody reads its help
            return 0
        raise
    except click.exceptions.Abort as error:
        if isinstance(error.__cause__, EOFError):  # click takes it for an end of what is typed
            return _unexpected(error.__cause__)
        return _fail("interrupted", 130)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except click.ClickException as error:
        shown = io.StringIO()
        error.show(file=shown)
        return _fail_with(shown.getvalue().rstrip("\n"), 2)
    except PlenoError as error:
        if debug:
            raise
        return _fail(str(error), error.exit_code)
    except MemoryError as error:
        if debug:
            raise
        return _fail(lack_of_memory(error), 5)
    except Exception as error:  # the last line of defence: a bug must not look like a usage error
        if debug:
            raise
        return _unexpected(error)


def _unexpected(error: BaseException) -> int:
    """The exit code for what no stage expected: of the machine, or a bug."""
    if is_lack_of_memory(error):
        return _fail(lack_of_memory(error), 5)
    if isinstance(error, FileNotFoundError) and not _has_working_directory():
        return _fail("the working directory is gone; run again in one that stays", 4)
    if isinstance(error, OSError) and (error.filename or error.errno in _NO_SPACE):
        return _fail(
            f"{error.filename or 'a file'}: {error.strerror}; check the name, the permissions and "
            "the space on the disk",
            4 if error.errno in _NO_SPACE else 3,
        )
    return _fail(
        f"internal error, a bug of plenocli: {type(error).__name__}: {error}\n"
        "Run again with PLENOCLI_DEBUG=1 for the traceback and report it with the command.",
        70,
    )


def _has_working_directory() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


def _fail(message: str, code: int) -> int:
    return _fail_with(f"plenocli: error: {message}", code)


def _fail_with(text: str, code: int) -> int:
    tell(text, error=True)
    return code

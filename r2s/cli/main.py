"""The command line `r2s`: data, pictures, plans, simulations, estimates. `r2s --help` begins.

Exit codes: 0; 1 for an error, 2 for wrong usage, in one line on stderr. The commands are in
`r2s.cli`.
"""

import contextlib
import gc
import inspect
import io
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Any, Union

try:
    import tyro
    from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, OmitSubcommandPrefixes, subcommand
except ImportError:
    sys.exit("r2s: error: the command line needs tyro: pip install 'r2s[cli]'")

from r2s import compilation
from r2s.cli import usage
from r2s.cli.checks import CheckGrad, Doctor
from r2s.cli.estimate import EstimateCard
from r2s.cli.evaluate import Evaluate
from r2s.cli.motions import Export, Sensitivity, Simulate
from r2s.cli.recordings import Check, Data, Show
from r2s.cli.study import Study
from r2s.cli.view import View
from r2s.estimation.cards import version
from r2s.study.engine import compile_fast

NO_CACHE = "--no-cache"
COMMANDS = {
    "simulate": Simulate,
    "data": Data,
    "check": Check,
    "show": Show,
    "estimate": EstimateCard,
    "evaluate": Evaluate,
    "view": View,
    "export": Export,
    "sensitivity": Sensitivity,
    "check-grad": CheckGrad,
    "doctor": Doctor,
    "study": Study,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line (None: that of the process); the exit code.

    Raises SystemExit, with 0 after --help and 2 after a wrong usage, whose message is on stderr.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"r2s {version()}")
        return 0
    try:
        command = _parse([each for each in arguments if each != NO_CACHE])
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            return command.run() or 0
    except BrokenPipeError:  # whoever read the output had enough
        sys.stdout = None
    except (ValueError, OSError, ImportError, RuntimeError, MemoryError) as error:
        message = " ".join(str(error).split())
        if isinstance(error, OSError) and error.strerror:  # no "[Errno 2]"
            message = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
        if "RESOURCE_EXHAUSTED" in message:
            message += " Take fewer frames, shorter motions or a coarser mesh."
        print(f"r2s: error: {message}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("r2s: error: interrupted", file=sys.stderr)
        return 1
    return 0


def _parse(arguments: Sequence[str]) -> Any:
    """The command with its arguments; SystemExit after help, and after one line on wrong usage."""
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            return _tyro(arguments)
    except SystemExit as stop:
        if not stop.code:
            raise
    first = arguments[: 2 if arguments[:1] == ["data"] else 1]
    names = [each for each in first if not each.startswith("-")]
    wrong = usage.explain(_told(arguments), arguments, _told([*names, "--help"]))
    print(f"r2s: error: {wrong}", file=sys.stderr)
    raise SystemExit(2)


def _told(arguments: Sequence[str]) -> str:
    """What tyro prints before it ends the program; without a terminal there are no boxes."""
    told = io.StringIO()
    with (
        contextlib.redirect_stdout(told),
        contextlib.redirect_stderr(told),
        contextlib.suppress(SystemExit),
    ):
        _tyro(arguments)
    return told.getvalue()


def _tyro(arguments: Sequence[str]) -> Any:
    return tyro.cli(
        _choice(is_list=not set(arguments) & set(COMMANDS)),
        prog="r2s",
        description=(
            "r2s: real-to-sim for fabrics. Each command tells more with --help. Compiled "
            "programs are kept in the cache folder of the user, or in that of "
            f"JAX_COMPILATION_CACHE_DIR; {NO_CACHE}, with any command, keeps and reads none."
        ),
        args=arguments,
        config=(OmitArgPrefixes, OmitSubcommandPrefixes, FlagCreatePairsOff),
    )


def _choice(is_list: bool) -> Any:
    """All commands, for tyro, which shows one text for a command in the list of all and in its own
    help: in the list the first sentence, else all of it."""
    kinds = []
    for name, kind in COMMANDS.items():
        first = (inspect.getdoc(kind) or "").split("\n\n")[0]
        text = " ".join(first.split()) if is_list else None
        kinds.append(Annotated[kind, subcommand(name, description=text)])
    return Union[tuple(kinds)]  # noqa: UP007


def command() -> int:
    """`main` in a process of its own, which keeps what it compiles."""
    gc.set_threshold(100_000, 50, 100)  # to trace makes many objects that stay
    os.environ["XLA_FLAGS"] = compile_fast(os.environ.get("XLA_FLAGS", ""))  # JAX has not begun yet
    if NO_CACHE in sys.argv:
        compilation.forget()
    else:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            compilation.keep()
    return main()


def _warn(message, *_, **__) -> None:
    print(f"r2s: warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(command())

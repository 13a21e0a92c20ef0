"""A wrong command line in one sentence: what is wrong, and the nearest command or option.

What is wrong is read from what tyro prints, which is long and in a frame.
"""

import re
from collections.abc import Sequence
from difflib import get_close_matches

OPTION = re.compile(r"--?[A-Za-z][\w-]*")
ARGUMENT = re.compile(r"(?m)^ {4,7}(\S.*?) *$")
KINDS = {  # tyro's words for values
    "INT": "a whole number",
    "INT INT": "two whole numbers",
    "FLOAT": "a number",
    "FLOAT FLOAT": "two numbers",
    "KG/M^2": "a number in kg/m^2",
}


def explain(error: str, arguments: Sequence[str], overview: str) -> str:
    """What is wrong with `arguments`.

    `error`: what tyro says of it. `overview`: its help on the command, or on all commands.
    """
    usage = overview.partition("\n\n")[0].removeprefix("usage: ")
    path = usage.partition(" [")[0]
    if commands := re.search(r"\{(.*)\}$", usage):
        said = _no_command(path, arguments, commands[1].split(","))
    else:
        said = _no_option(path, arguments, usage, overview) or _sentence(path, error)
    return f"{said} (see {path} --help)"


def _no_command(path: str, arguments: Sequence[str], commands: Sequence[str]) -> str:
    words = arguments[len(path.split()) - 1 :]
    if not words:
        return f"{path} needs a command: {', '.join(commands)}"
    near = get_close_matches(words[0], commands, n=1)
    hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(commands)}"
    return f"{path} has no command {words[0]}: {hint}"


def _no_option(path: str, arguments: Sequence[str], usage: str, overview: str) -> str:
    """Of the first option that the command lacks; "" where it has all of them."""
    lines = [line for line in overview.splitlines() if line.startswith("  -")]
    known = list(dict.fromkeys(re.findall(r"--[a-z][a-z-]*", " ".join(lines))))
    for argument in arguments:
        given = argument.partition("=")[0]
        name = given.replace("_", "-")
        if not OPTION.fullmatch(given) or name in {*known, "-h"}:
            continue
        near = get_close_matches(f"--{name.lstrip('-')}", known, n=1)
        takes = [*usage.rpartition("]")[2].split(), *known]
        hint = f"did you mean {near[0]}?" if near else f"it takes {', '.join(takes)}"
        return f"{path} has no option {given}: {hint}"
    return ""


def _sentence(path: str, error: str) -> str:
    """What tyro says, without its title, its help and Python's words for types."""
    title, said, *rest = re.split(r"(?m)^ *-{3,} *$", error + "\n----")
    words = " ".join(said.split())
    if wrong := re.match(r"Error parsing ([\w-]+):.*?('.*?')", words):
        lines = (line.strip() for part in rest for line in part.splitlines())
        usual = next((line for line in lines if line.startswith(f"{wrong[1]} ")), "a value")
        usual = usual.removeprefix(f"{wrong[1]} ")
        expected = re.sub(r"\{None\}\||[{}]", "", usual)
        return f"{wrong[1]} expects {KINDS.get(expected, expected)}, got {wrong[2]}"
    if words.startswith("Missing from"):  # what an argument is for is indented more
        return f"{path} needs {', '.join(ARGUMENT.findall(said))}"
    if words.startswith("Unrecognized options: "):
        return f"too many arguments: {words.partition(': ')[2]}"
    return words.replace("Expected 1 values", "").strip(" .") or title.strip()

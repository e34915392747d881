"""Whether a configuration of events fits the terms of an Isaac Lab that is not installed.

Isaac Lab needs Isaac Sim and a GPU, but its wheel can be read. Export the events, download the
wheel, and compare:

    npdr export fit arm.xml --to events.py --as isaac-lab
    python -m pip download --no-deps isaaclab==2.3.2.post1
    python benchmarks/isaac_lab.py events.py isaaclab-*.whl

Compared are the name of every term and the names of its arguments, as Isaac Lab's event manager
compares them. Nothing of the wheel is run.
"""

import ast
import re
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

EVENTS = re.compile(r"(?:^|/)isaaclab/envs/mdp/events\.py$")
NUM_OWN = 2
"""Arguments that the event manager gives itself: the environment and the numbers of copies."""


@dataclass(frozen=True)
class Signature:
    """Arguments of a term, without those that the manager gives.

    Attributes:
        required: Arguments without a default.
        optional: The others.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...]


def signatures(text):
    """Returns the signature of each function and each class that can be called.

    Args:
        text: Source of ``isaaclab/envs/mdp/events.py``.
    """
    found = {}
    for node in ast.parse(text).body:
        function, num = node, NUM_OWN
        if isinstance(node, ast.ClassDef):
            own = [m for m in node.body if getattr(m, "name", "") == "__call__"]
            function, num = own[0] if own else None, NUM_OWN + 1
        if isinstance(function, ast.FunctionDef):
            names = [argument.arg for argument in function.args.args]
            split = len(names) - len(function.args.defaults)
            found[node.name] = Signature(tuple(names[num:split]), tuple(names[split:]))
    return found


def terms(text):
    """Returns the function and the arguments of each term of a configuration.

    Args:
        text: Source that ``npdr export`` wrote.
    """
    found = {}
    for node in ast.walk(ast.parse(text)):
        if not (isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)):
            continue
        given = {k.arg: k.value for k in node.value.keywords}
        if isinstance(given.get("func"), ast.Attribute) and isinstance(given["params"], ast.Dict):
            names = [key.value for key in given["params"].keys]
            found[node.targets[0].id] = given["func"].attr, names
    return found


def faults(configuration, known):
    """Returns a sentence for each term that Isaac Lab would refuse.

    Args:
        configuration: Source that ``npdr export`` wrote.
        known: Signatures of Isaac Lab's terms.
    """
    found = []
    for name, (function, given) in terms(configuration).items():
        if function not in known:
            found.append(f"{name}: there is no {function}")
            continue
        required, optional = known[function].required, known[function].optional
        missing = sorted(set(required) - set(given))
        unknown = sorted(set(given) - {*required, *optional})
        found += [f"{name}: {function} needs {argument}" for argument in missing]
        found += [f"{name}: {function} has no {argument}" for argument in unknown]
    return found


def events_of(path):
    """Returns the source of the terms in a wheel, or of a file."""
    if path.suffix != ".whl":
        return path.read_text()
    with zipfile.ZipFile(path) as wheel:
        (name,) = (name for name in wheel.namelist() if EVENTS.search(name))
        return wheel.read(name).decode()


def main():
    if len(sys.argv) < 3:
        sys.exit("Give an exported file and wheels: isaac_lab.py events.py isaaclab-2.3.2.whl")
    configuration = Path(sys.argv[1]).read_text()
    if not terms(configuration):
        sys.exit(f"{sys.argv[1]} has no terms of events; npdr export --as isaac-lab writes them.")
    is_wrong = False
    for wheel in map(Path, sys.argv[2:]):
        found = faults(configuration, signatures(events_of(wheel)))
        is_wrong |= bool(found)
        print(f"{wheel.name}: {len(terms(configuration))} terms, {len(found)} faults")
        print(*(f"    {fault}" for fault in found), sep="\n", end="\n" if found else "")
    sys.exit(int(is_wrong))


if __name__ == "__main__":
    main()

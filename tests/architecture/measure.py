"""Measures of how hard the code is to carry: values of today and the goals of the redesign.

`python -m tests.architecture.measure` prints them. `--update` records what fell and refuses to raise anything. With `--traced` it traces
calls too. `--list NAME` prints what a measure counts. The recorded values are in ratchet.toml.

Files touched by a change are those that name one existing example. The examples are the format `rcs`, the method `dual_dice`, the kind
`distill`, the outcome `tremor` and the column `probability_best`.

The redesign's first values were counted in the same ways, with these exceptions:

* Its 26 mutual dependencies and 40 imports that go up exclude modules of wording.
* Its modules entered by a call (37, 20, 24, 25) are those of the main path, read by a person. Here every module counts.
* Its 75 files of an outcome are an estimate.
* Its 188 small files of `app` cannot be found again: 151 have fewer than 40 lines, 214 fewer than 40 that are not blank.
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

if __name__ == "__main__":  # started as a script
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.architecture import prose
from tests.architecture.texts import ROOT, imports_of, nodes_of, source, tracked_files

RATCHET = Path(__file__).parent / "ratchet.toml"
COMMAND = "python -m tests.architecture.measure --update"
TRACED = "modules entered"
TRACING = "tests/app/planning/test_modules_entered.py"


class Measure(NamedTuple):
    """A measure: its goal, and the step that it is recorded in, so that lines need not be recorded for each change."""

    goal: str
    step: int = 1


MEASURES = {
    "product files that name two or more outcomes": Measure("12"),
    "files touched: device format, besides its package": Measure("1"),
    "files touched: OPE method": Measure("2"),
    "files touched: job kind": Measure("2"),
    "files touched: outcome": Measure("4"),
    "files touched: ranking column": Measure("3"),
    "files that name the lower bound": Measure("15"),
    "mutual dependencies between features of a phase": Measure("3"),
    "imports that go up": Measure("0"),
    "tables by string": Measure("0"),
    "functions on app.state": Measure("0"),
    "Python files in app": Measure("340"),
    "Python files in app below 40 lines": Measure("30"),
    "lines of product": Measure("88 000", 500),
    "lines of tests": Measure("55 000", 500),
    "lines of benchmarks": Measure("4 500", 500),
    "modules entered: upload to trace": Measure("25"),
    "modules entered: ranking page": Measure("12"),
    "modules entered: ranking page, cached": Measure("12"),
    "modules entered: sign a plan": Measure("14"),
    "modules entered: bundle": Measure("15"),
    "banned words": Measure("0"),
    "template lines above 200 characters": Measure("50"),
    "calls of db.commit()": Measure("15"),
}


# files


def product() -> list[str]:
    """List the Python files of `app` and `ml`."""
    return [path for path in tracked_files() if path.startswith(("app/", "ml/")) and path.endswith(".py")]


def word(name: str) -> re.Pattern[str]:
    """Match a name as a word or as a part of one between underscores, so that `rating` is found in `rating_of` but not in `operating`."""
    return re.compile(rf"(?<![a-z]){name}(?![a-z])")


def naming(*names: str, least: int = 1) -> list[str]:
    """List the product files that name at least so many of some words."""
    patterns = [word(name) for name in names]
    return [path for path in product() if sum(bool(p.search(source(path))) for p in patterns) >= least]


def code_lines(path: str) -> int:
    """Count the lines of a file."""
    return source(path).count("\n")


OUTCOMES = ("grasp", "rating", "tremor")


def of_record(home: str, key: str) -> list[str]:
    """List the home of one record (a file or a package) and the product files outside it that name its key as a word."""
    pattern = re.compile(rf"\b{re.escape(key)}\b")
    return [home, *(path for path in product() if not path.startswith(home) and pattern.search(source(path)))]


# imports


@cache
def imports() -> frozenset[tuple[str, str]]:
    """Collect (importing, imported) modules of `app`, at whatever depth of the code."""
    modules = {module_name(path): path for path in product() if path.startswith("app/")}
    found: set[tuple[str, str]] = set()
    for module, path in modules.items():
        for node in imports_of(path):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [name if name in modules else str(node.module) for name in whole]
            found.update((module, name) for name in names if name in modules and name != module)
    return frozenset(found)


def module_name(path: str) -> str:
    """Name the module of a file."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def packages() -> frozenset[str]:
    """Collect the packages of `app`."""
    return frozenset(module_name(path) for path in product() if path.startswith("app/") and path.endswith("__init__.py"))


def feature(module: str) -> str:
    """Name the feature of a module: the package below its phase, or the phase for modules of its root."""
    parts = module.split(".")
    below = ".".join(parts[:3])
    return below if len(parts) > 2 and below in packages() else ".".join(parts[:2])


@cache
def between_features() -> Mapping[tuple[str, str], tuple[tuple[str, str], ...]]:
    """Group the imports between features of one phase, by (importing, imported) feature."""
    found = defaultdict(list)
    for importing, imported in sorted(imports()):
        pair = feature(importing), feature(imported)
        if pair[0] != pair[1] and len({name.partition(".")[2].partition(".")[0] for name in pair}) == 1:
            found[pair].append((importing, imported))
    return {pair: tuple(edges) for pair, edges in found.items()}


def mutual() -> list[str]:
    """List pairs of features of one phase that import each other; the modules of a phase's root count as one feature."""
    pairs = between_features()
    return [f"{a} <-> {b}" for a, b in pairs if a < b and (b, a) in pairs]


def upward() -> list[str]:
    """List imports of a feature by a root module of its phase that a feature of the phase imports itself; none goes up between phases."""
    used = {b for (a, _), edges in between_features().items() if a.count(".") == 2 for _, b in edges}
    return [
        f"{a} -> {b}"
        for (_, to), edges in between_features().items()
        if to.count(".") == 2
        for a, b in edges
        if feature(a).count(".") == 1 and a in used
    ]


# single constructs


def tables_by_string() -> list[str]:
    """List calls `table("name", ...)`, which name a table by a string."""
    found = []
    for path in product():
        if "table(" not in source(path):
            continue
        for node in nodes_of(path).calls:
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name == "table" and node.args and isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str):
                found.append(f"{path}:{node.lineno} {node.args[0].value}")
    return found


def on_state() -> list[str]:
    """List functions of a later phase that `app.main` hangs on `app.state`, so that an earlier one can call them."""
    found = []
    for node in nodes_of("app/main.py").assigned:
        for target in node.targets:
            hung = isinstance(target, ast.Attribute) and ast.unparse(target.value) == "app.state"
            if hung and isinstance(node.value, ast.Name) and node.value.id.islower():
                found.append(ast.unparse(node))
    return found


def occurrences(pattern: str, paths: Iterable[str]) -> list[str]:
    """List the places of lines that match a pattern, one for each match."""
    return [f"{path}:{i}" for path in paths for i, line in enumerate(source(path).splitlines(), 1) for _ in re.findall(pattern, line)]


@cache
def measurements() -> Mapping[str, tuple[int, tuple[str, ...]]]:
    """Take every measure but those of traced calls: its value, and what it counts where that can be listed."""
    prose.findings()  # parses every file, so that their imports are known below
    app = [path for path in product() if path.startswith("app/")]
    lists = {
        "product files that name two or more outcomes": naming(*OUTCOMES, least=2),
        "files touched: device format, besides its package": of_record("ml/formats/rcs/", "rcs")[1:],
        "files touched: OPE method": of_record("ml/ope/dual_dice.py", "dual_dice"),
        "files touched: job kind": of_record("app/pipeline/distillation.py", "app.pipeline.distillation:run_distil"),
        "files touched: outcome": of_record("ml/outcomes/", "tremor"),
        "files touched: ranking column": [p for p in (*product(), *templates()) if re.search(r"\bprobability_best\b", source(p))],
        "files that name the lower bound": [path for path in product() if "lower_bound" in source(path)],
        "mutual dependencies between features of a phase": mutual(),
        "imports that go up": upward(),
        "tables by string": tables_by_string(),
        "functions on app.state": on_state(),
        "Python files in app": app,
        "Python files in app below 40 lines": [path for path in app if code_lines(path) < 40],
        "banned words": [f"{f.path}:{f.line} {f.about}" for f in prose.findings() if f.rule == "banned words"],
        "template lines above 200 characters": occurrences(r"^.{201,}", templates()),
        "calls of db.commit()": occurrences(r"\bdb\.commit\(\)", product()),
    }
    files = {"product": product(), "tests": python_of("tests"), "benchmarks": python_of("benchmarks")}
    lines = {f"lines of {name}": (sum(map(code_lines, paths)), ()) for name, paths in files.items()}
    return {name: (len(found), tuple(found)) for name, found in lists.items()} | lines


def templates() -> list[str]:
    """List the templates."""
    return [path for path in tracked_files() if path.startswith("app/templates/")]


def python_of(folder: str) -> list[str]:
    """List the Python files below a folder."""
    return [path for path in tracked_files() if path.startswith(f"{folder}/") and path.endswith(".py")]


# the ratchet


def ratchet() -> dict[str, dict[str, Any]]:
    """Read the recorded values: of `measures`, of each rule of prose by folder, and of `subjects`."""
    return tomllib.loads(RATCHET.read_text()) if RATCHET.exists() else {}


def current() -> dict[str, dict[str, int]]:
    """Take the values of today, but those of traced calls, which are taken over from the record."""
    traced = {name: value for name, value in ratchet().get("measures", {}).items() if name.startswith(TRACED)}
    values = {name: value for name, (value, _) in measurements().items()} | traced
    return {"measures": {name: values[name] for name in MEASURES if name in values}, **prose.counts(prose.findings())}


def differences(old: Mapping[str, int], new: Mapping[str, int]) -> tuple[list[str], list[str]]:
    """Compare values with those recorded.

    Returns:
        What rose, and what fell by a whole step without being recorded.
    """
    steps = {name: MEASURES[name].step if name in MEASURES else 1 for name in sorted({**old, **new})}
    rose = [f"{n}: {old.get(n, 0)} -> {new.get(n, 0)}" for n in steps if new.get(n, 0) > old.get(n, 0)]
    fell = [f"{n}: {old[n]} -> {new.get(n, 0)}" for n, step in steps.items() if old.get(n, 0) - new.get(n, 0) >= step]
    return rose, fell


def unlike_record(
    values: Mapping[str, int], table: str = "measures", details: Mapping[str, Iterable[str]] | None = None, exact: bool = True
) -> list[str]:
    """Describe which values rose, and which fell without being recorded.

    Args:
        values: by name; recorded values of other names are not looked at.
        table: of the ratchet.
        details: what was counted, by a part of the name, for the message.
        exact: a value that fell must be recorded. Not so where it also depends on what the process has loaded before.
    """
    rose, fell = differences({name: value for name, value in ratchet().get(table, {}).items() if name in values}, values)
    listed = "".join(f"\n{name}: {', '.join(sorted(found))}" for name, found in (details or {}).items() if any(name in r for r in rose))
    risen = [f"{table} may only fall: {'; '.join(rose)}{listed}"] if rose else []
    record = f"{table} fell: {'; '.join(fell)}. Record it: `{COMMAND}`, with `--traced` for modules entered."
    return [*risen, record] if exact and fell else risen


def trace_calls() -> dict[str, int]:
    """Run the test that traces calls, and read the properties that it records, whether or not they rose."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "report.xml"
        subprocess.run([sys.executable, "-m", "pytest", "-q", f"--junitxml={target}", TRACING], cwd=ROOT, check=False)
        recorded = {p.attrib["name"]: int(p.attrib["value"]) for p in ElementTree.parse(target).iter("property")}
    if not recorded:
        raise RuntimeError(f"{TRACING} recorded nothing: see above why it failed")
    return recorded


def update(more: Mapping[str, int]) -> list[str]:
    """Record the values of today, lines rounded up to their step.

    Args:
        more: measured values that take the place of recorded ones.

    Returns:
        What rose. Nothing is recorded then.
    """
    old, new = ratchet(), current()
    new["measures"] |= more
    rose = [f"{table}: {line}" for table, values in new.items() if table in old for line in differences(old[table], values)[0]]
    if rose:
        return rose
    for name, measure in MEASURES.items():
        if name in new["measures"]:
            above = -(-new["measures"][name] // measure.step) * measure.step
            new["measures"][name] = min(above, old.get("measures", {}).get(name, above))
    RATCHET.write_text(to_toml({**new, **{table: values for table, values in old.items() if table not in new}}))
    return []


def to_toml(tables: Mapping[str, Mapping[str, object]]) -> str:
    """Write tables as TOML."""
    head = f"# Values that may only fall, written by `{COMMAND}`. tests/architecture/measure.py says how each is counted.\n"
    parts = [f'\n["{table}"]\n' + "".join(f'"{n}" = {value(v)}\n' for n, v in rows.items()) for table, rows in tables.items()]
    return head + "".join(parts)


def value(content: object) -> str:
    """Write a value as TOML."""
    return json.dumps(content)


def main(arguments: list[str]) -> int:
    """Print the measures, update the ratchet, or list what a measure counts."""
    if arguments[:1] == ["--list"]:
        sys.stdout.write("".join(f"{line}\n" for name in arguments[1:] for line in measurements()[name][1]))
        return 0
    if arguments[:1] == ["--update"]:
        rose = update(trace_calls() if "--traced" in arguments else {})
        sys.stderr.write("".join(f"rose: {line}\n" for line in rose) + ("nothing was written\n" if rose else ""))
        return bool(rose)
    now = current()
    for name, measure in MEASURES.items():
        sys.stdout.write(f"{name:<55}{now['measures'].get(name, 'unknown'):>8}   goal {measure.goal}\n")
    for rule in prose.RULES:
        folders = Counter(now[rule])
        sys.stdout.write(f"{rule:<55}{folders.total():>8}   goal 0   {', '.join(f'{f} {n}' for f, n in folders.items())}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

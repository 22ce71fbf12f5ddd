"""Changes single places of Python files and page modules, one at a time, and runs the tests: does one fail?

A change that no test notices survives: no test asserts what the line does, or the line is not needed. Tests run in a
copy of the tree, collected once; for each change, a forked process replaces the code of its function and runs the rows
that reach its line. Programs that tests start run unchanged code. A line that runs while tests are imported (a
constant, a class body, a default) is changed in the copy and tried by all rows in a new process, which takes seconds.
Calls that log are counted apart. A hang counts as killed. A row is a test function with its parameters, an arc a step
from one line to the next. A page module is changed in the copy and tried by all rows; if no tests are named, by those
of tests/ext/page/modules, which run in Node. What is inside its strings and templates is not changed.
"""

import argparse
import ast
import ctypes
import functools
import gc
import itertools
import json
import os
import re
import select
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, NoReturn
from zlib import crc32

import grimp
import pytest

ROOT = Path.cwd().resolve()
sys.path[0] = str(ROOT)  # instead of the folder of this program
SCREEN = os.fdopen(os.dup(2), "w", buffering=1)  # for progress: processes that run tests have no other output
LOG = re.compile(r"[\w.]*log(ger|ging)?\.(debug|info|warning|error|exception|critical|log)\(")
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+::.*?)(?: - .*)?$", re.MULTILINE)  # in pytest's summary
PAIRS: list[Any] = [(ast.FloorDiv, ast.Mult), (ast.Mult, ast.Div), (ast.Add, ast.Sub), (ast.And, ast.Or)]
PAIRS += [(ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn)]
SWAPPED = {second: first for first, second in PAIRS} | dict(PAIRS)
#: Of a page module: what is left out, the beginning of a function, and what is changed, by operator.
SCRIPT = re.compile(
    r"""//[^\n]*|/\*.*?\*/|'(?:\\.|[^'\\\n])*'|"(?:\\.|[^"\\\n])*"|`(?:\\.|[^`\\])*`"""
    r"|^(?:export )?(?:async )?(?:function|class) (?P<function>\w+)"
    r"|^  (?:static |async |get |set )*(?P<method>#?\w+)\([^\n]*\{$"
    r"|(?P<compare> (?:[<>]=?|[!=]==) )|(?P<logic> (?:&&|\|\|) )|(?P<arithmetic> [-+*/] )|(?P<not>!(?=[\w(]))"
    r"|(?P<constant>(?<![\w.])(?:true|false|\d+(?:\.\d+)?)(?!\w))|(?P<return>\breturn (?=[^;\n]))|(?P<if>\bif \((?!!))",
    re.DOTALL | re.MULTILINE,
)
SCRIPT_WORDS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "===": "!==", "!==": "===", "&&": "||", "||": "&&"}
SCRIPT_WORDS |= {"+": "-", "-": "+", "*": "/", "/": "*", "!": "", "true": "false", "false": "true"}
SCRIPT_WORDS |= {"return": "return void", "if (": "if (true || "}
Mutant = tuple[dict[str, Any], set[tuple[str, int]], bytes]  # a record, the lines that run when it does, the new text


def mutants(file: str, text: bytes) -> Iterator[Mutant]:
    """Yield the mutants of a file.

    A name holds the function, the operator and a running number, not the line: it stays when lines move.
    """
    starts = [0, *itertools.accumulate(map(len, text.splitlines(keepends=True)))]
    numbers: Counter[str] = Counter()

    def walk(node: Any, function: str, statement_line: int) -> Iterator[Mutant]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            function = f"{function}.{node.name}".lstrip(".")
        statement_line = node.lineno if isinstance(node, ast.stmt) else statement_line
        is_log = False
        for operator, part, new in replacements(node):
            is_log = is_log or operator == "log"
            name = f"{file}:{function or '<module>'}:{operator}"
            numbers[name] += 1
            start, end = starts[part.lineno - 1] + part.col_offset, starts[part.end_lineno - 1] + part.end_col_offset
            newlines = text.count(b"\n", start, end) * "\n"  # so that what follows stays on its lines
            replacement = ast.unparse(new) + newlines
            if not isinstance(new, ast.Constant | ast.Pass):  # so that it stays one operand
                replacement = f"({replacement})"
            change = " ".join(f"{text[start:end].decode()} -> {ast.unparse(new)}".split())
            record = {"name": f"{name}:{numbers[name]}", "file": file, "line": part.lineno, "change": change}
            reached_by = {(file, line) for line in (statement_line, *range(part.lineno, part.end_lineno + 1))}
            yield record, reached_by, text[:start] + replacement.encode() + text[end:]
        # Not walked, so not mutated: annotations and decorators, taken out here, and what a log call or f-string holds.
        vars(node).update(annotation=None, returns=None, decorator_list=[])
        if not is_log and not isinstance(node, ast.JoinedStr):
            for child in ast.iter_child_nodes(node):
                yield from walk(child, function, statement_line)

    return walk(ast.parse(text), "", 0)


def script_mutants(file: str, text: bytes) -> Iterator[Mutant]:
    """Yield the mutants of a page module, named like those of :func:`mutants`."""
    script, function = text.decode(), "<module>"
    numbers: Counter[str] = Counter()
    for match in SCRIPT.finditer(script):
        operator, old = match.lastgroup, match.group()
        if operator in ("function", "method"):  # no operator: the mutants that follow are in it
            function = match.group(operator)
        elif operator is not None:  # None: a comment or a string
            stripped = old.strip()
            new = old.replace(stripped, SCRIPT_WORDS.get(stripped, f"({stripped} + 1)"))  # + 1: a number
            name, line = f"{file}:{function}:{operator}", script.count("\n", 0, match.start()) + 1
            numbers[name] += 1
            change = f"{stripped} -> {new.strip()}"
            record = {"name": f"{name}:{numbers[name]}", "file": file, "line": line, "change": change}
            yield record, {(file, line)}, (script[: match.start()] + new + script[match.end() :]).encode()


def replacements(node: Any) -> Iterator[tuple[str, Any, ast.AST]]:
    """Yield each change of this node: the operator, the part that is removed, and its replacement."""
    match node:
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return
        case ast.Compare():
            for at, compared in enumerate(node.ops):
                ops = [*node.ops[:at], SWAPPED[type(compared)](), *node.ops[at + 1 :]]
                yield "compare", node, ast.Compare(node.left, ops, node.comparators)
        case ast.BoolOp():
            yield "logic", node, ast.BoolOp(SWAPPED[type(node.op)](), node.values)
        case ast.BinOp() if type(node.op) in SWAPPED:
            yield "arithmetic", node, ast.BinOp(node.left, SWAPPED[type(node.op)](), node.right)
        case ast.UnaryOp(op=ast.Not()):
            yield "not", node, node.operand
        case ast.Constant(value=bool() | int() | float() as value):
            yield "constant", node, ast.Constant(not value if isinstance(value, bool) else value + 1)
        # None in place of False, 0 or "" is as false
        case ast.Return(value=ast.expr()) if not isinstance(node.value, ast.Constant) or node.value.value:
            yield "return", node.value, ast.Constant(None)
        case ast.Expr(value=ast.Call() | ast.Await()):
            yield "log" if LOG.match(ast.unparse(node)) else "call", node, ast.Pass()
        # these tests have changes of their own, above
        case ast.If() | ast.While() | ast.IfExp() if type(node.test) not in (ast.Compare, ast.UnaryOp, ast.Constant):
            yield "if", node.test, ast.UnaryOp(ast.Not(), node.test)


def tests_that_import(files: list[str]) -> list[str]:
    """Return the test files that import one of these files, also indirectly; for page modules, a folder of tests."""
    if all(file.endswith(".js") for file in files):
        return ["tests/ext/page/modules"]
    packages = {"tests", *(path.parent.name for path in ROOT.glob("*/__init__.py"))}
    graph = grimp.build_graph(*packages, exclude_type_checking_imports=True, cache_dir=None)
    places = {name: (ROOT / f"{name.replace('.', '/')}.py").resolve() for name in graph.modules}
    modules = [name for name, place in places.items() if str(place.relative_to(ROOT)) in files]
    tests = {places[name].relative_to(ROOT) for module in modules for name in graph.find_downstream_modules(module)}
    return sorted(str(path) for path in tests if path.name.startswith("test_"))


def forked(work: Callable[[], object], seconds: float | None = None) -> bool:
    """Run ``work`` in a child process, and kill what it leaves behind; True if it succeeds within its time."""
    ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER: a process whose parent ends becomes a child of this one
    others = set(children())
    try:
        pid = os.fork()
        if pid == 0:  # the child
            run_and_exit(work)  # never returns
        descriptor = os.pidfd_open(pid)
        ended, _, _ = select.select([descriptor], [], [], seconds)
        os.close(descriptor)
        return bool(ended) and os.waitpid(pid, 0)[1] == 0
    finally:
        while orphans := set(children()) - others:
            for child in orphans:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)


def run_and_exit(work: Callable[[], object]) -> NoReturn:
    """Run ``work`` and end this process, which has its own group and no terminal."""
    try:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        for descriptor in range(3):
            os.dup2(os.open(os.devnull, os.O_RDWR), descriptor)
        os._exit(not work())  # 0 if it returned what is true
    finally:
        os._exit(1)


def children() -> Iterator[int]:
    """Yield the processes whose parent is this one."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(path.read_text().rpartition(")")[2].split()[1]) == os.getpid():
                yield int(path.parent.name)


def lines_of(arcs: Iterable[Sequence[Any]]) -> set[tuple[str, int]]:
    """Return the lines from and to which the arcs lead, each with its file."""
    return {(file, line) for file, *ends in arcs for line in ends}


class Trial:
    """A plugin for pytest that runs the collected rows without a mutant, and with each, in a copy of the tree."""

    def __init__(self, files: list[str], tests: list[str], work: Path, options: argparse.Namespace) -> None:
        # The copy of the tree, and files in which child processes note the rows that failed, and those that passed.
        self.tree, self.failed, self.passed, self.options = work / "tree", work / "failed", work / "passed", options
        self.texts = {file: (ROOT / file).read_bytes() for file in files}
        self.file_of = functools.cache(lambda path: os.path.relpath(os.path.realpath(path), self.tree))
        #: By file, qualified name and first line.
        self.functions: defaultdict[tuple[str, str, int], list[FunctionType]] = defaultdict(list)
        self.arcs: set[tuple[str, int, int]] = set()  # of a row: file, from which line, to which; 0: the function ends
        marks = "page or alone" if options.thorough else "page or alone or thorough"
        self.arguments = ["-qqs", f"--rootdir={self.tree}", f"--basetemp={work}/t", "-m", f"not ({marks})", *tests]
        self.arguments += ["--hypothesis-seed=0"]  # so that no example that failed is tried first with another mutant

    def run(self) -> int:
        """Collect the tests in the copy and run them; return pytest's exit code."""
        left_out = shutil.ignore_patterns(".git", ".venv", ".*_cache", ".hypothesis", "build", "dist")
        shutil.copytree(ROOT, self.tree, symlinks=True, ignore=left_out)
        if (ROOT / ".venv").exists():
            (self.tree / ".venv").symlink_to(ROOT / ".venv")
        os.chdir(self.tree)
        sys.path = [str(self.tree), *(path for path in sys.path if path != str(ROOT))]
        os.environ |= {"PYTHONPATH": sys.path[0], "TMPDIR": str(self.tree.parent), "PYTHONDONTWRITEBYTECODE": "1"}
        tempfile.tempdir = None  # so that TMPDIR is read again
        threading.settrace(self.trace)
        sys.settrace(self.trace)
        with self.options.out.open("w", buffering=1) as self.out:
            return int(pytest.main(self.arguments, plugins=[self]))

    def trace(self, frame: FrameType, event: str, _argument: object, last: int = 0) -> Any:
        """Collect the arcs of the files: a function for sys.settrace."""
        if (file := self.file_of(frame.f_code.co_filename)) not in self.texts:
            return None
        line = 0 if event == "return" else frame.f_lineno
        self.arcs.add((file, last, line))
        return functools.partial(self.trace, last=line)

    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        """Take the place of pytest's loop, unless a test could not be collected."""
        if session.testsfailed:
            return None
        self.session, self.items = session, {item.nodeid: item for item in session.items}
        self.imported = lines_of(self.arcs)  # so far only collecting has run
        self.passed.write_text("{}")
        # The rows run in a child, as later with each mutant: they leave nothing behind in this process.
        forked(lambda: self.passed.write_text(json.dumps(self.run_rows(list(self.items), stop=False))))
        sys.settrace(None)
        threading.settrace(None)
        self.read_rows()
        # Find all functions by their place, so that ``swaps`` can replace their code.
        gc.unfreeze()  # get_objects leaves out what tests/conftest.py has frozen
        for function in gc.get_objects():
            if isinstance(function, FunctionType) and function.__name__ != "<lambda>":  # of which a line may have two
                code = function.__code__
                self.functions[self.file_of(code.co_filename), code.co_qualname, code.co_firstlineno].append(function)
        gc.freeze()
        for file, text in self.texts.items():
            possible = script_mutants(file, text) if file.endswith(".js") else mutants(file, text)
            # A draw: by a hash of the name in each mutant's record, which the seed changes.
            drawn = sorted(possible, key=lambda mutant: crc32(mutant[0]["name"].encode(), self.options.seed))
            report(file, len(drawn), [self.attempt(*mutant) for mutant in drawn[: self.options.n or None]])
        return True

    def read_rows(self) -> None:
        """Read which rows pass without a mutant, fast modules first; print the names of the rows that fail."""
        passed = json.loads(self.passed.read_text())  # by the name of a row: its seconds, and its arcs
        module_of = {name: self.items[name].path for name in passed}
        self.slowest: defaultdict[Path, float] = defaultdict(float)  # seconds of a module's slowest row
        for name, (seconds, _) in passed.items():
            self.slowest[module_of[name]] = max(self.slowest[module_of[name]], seconds)
        seconds_of = {name: seconds for name, (seconds, _) in passed.items()}
        # rows of a module stay together, as they share what they set up
        names = sorted(passed, key=lambda name: (self.slowest[module_of[name]], seconds_of[name]))
        self.rows = {name: passed[name] for name in names}  # in the order of running; each: its seconds, and its arcs
        self.lines = {name: lines_of(arcs) for name, (_, arcs) in self.rows.items()}
        self.failing = FAILED.findall(self.failed.read_text())  # rows that fail without a mutant, too
        print(f"{len(names)} rows pass without a mutant; left out, as they fail: {', '.join(self.failing) or 'none'}")
        if not names:
            pytest.exit("no row passes without a mutant", 2)
        if self.options.matrix:
            self.write_arcs()

    def write_arcs(self) -> None:
        """Write which test functions cover each arc. By this --spare, in a later run, finds tests that may go."""
        covering: defaultdict[tuple[str, int, int], set[str]] = defaultdict(set)
        for name, (_, arcs) in self.rows.items():
            for arc in arcs:
                covering[tuple(arc)].add(name.partition("[")[0])
        for arc, functions in covering.items():
            print(json.dumps({"name": str(arc), "result": "arc", "killers": sorted(functions)}), file=self.out)

    def run_rows(self, names: list[str], stop: bool) -> dict[str, Any]:
        """Run rows, or only up to the first that fails if ``stop``; return the seconds and arcs of those that pass.

        The file ``failed`` then names the rows that failed.
        """
        passed, failed = {}, ""
        for number, (name, following) in enumerate(itertools.zip_longest(names, names[1:]), 1):
            if number % 100 == 0:
                print(f"{number} of {len(names)} rows", file=SCREEN)
            self.failed.write_text(f"{failed}FAILED {name}\n")  # which stays there if this row hangs
            self.arcs.clear()
            failures, start = self.session.testsfailed, time.monotonic()
            self.session.config.hook.pytest_runtest_protocol(item=self.items[name], nextitem=self.items.get(following))
            if self.session.testsfailed == failures:
                passed[name] = time.monotonic() - start, list(self.arcs.copy())
            else:
                failed += f"FAILED {name}\n"
                if stop:
                    break
        self.failed.write_text(failed)
        return passed

    def attempt(self, record: dict[str, Any], reached_by: set[tuple[str, int]], text: bytes) -> dict[str, Any]:
        """Run rows with a mutant; write the result, and return it."""
        start, file = time.monotonic(), record["file"]
        is_script = file.endswith(".js")  # a page module: the tests read it from the tree, no function is exchanged
        # Functions whose code a fork can exchange; none if the line runs while tests are imported. Without any, all
        # rows run with the changed file instead.
        swaps = [] if is_script or reached_by & self.imported else self.swaps(file, text)
        names = [name for name in self.rows if not swaps or reached_by & self.lines[name]]
        seconds = sum(self.rows[name][0] for name in names)  # which they took without a mutant
        # a row may now have to set up what its module shares: at most what the module's slowest row took
        modules = {self.items[name].path for name in names}
        seconds += sum(self.slowest[module] for module in modules)
        self.failed.write_text("")
        if is_script:
            (self.tree / file).write_bytes(text)
        in_fork = swaps or is_script
        work = (lambda: self.run_swapped(swaps, names)) if in_fork else (lambda: self.run_new(file, text))
        result = "not reached"
        if names:
            extra_s = 5 if in_fork else 60  # a new process collects the tests again
            limit_s = 5 * seconds + extra_s  # what takes longer hangs
            result = "survived" if forked(work, limit_s) else "killed"
        (self.tree / file).write_bytes(self.texts[file])
        record |= {"rows": len(names), "killers": FAILED.findall(self.failed.read_text()), "result": result}
        record["seconds"] = round(time.monotonic() - start, 2)
        print("{seconds:6.2f} s  {name} {result}".format(**record), file=SCREEN)
        print(json.dumps(record), file=self.out)
        return record

    def swaps(self, file: str, text: bytes) -> list[tuple[FunctionType, CodeType]]:
        """Return a file's functions, each with its code as compiled from ``text``; none if one cannot take its code."""
        codes = [compile(text, file, "exec", dont_inherit=True)]
        for code in codes:  # these grow meanwhile: code has the code of the functions in it
            codes += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
        places = ((code, (file, code.co_qualname, code.co_firstlineno)) for code in codes)
        swaps = [(function, code) for code, place in places for function in self.functions[place]]
        # Python lets a function take only code with the same free variables.
        possible = all(function.__code__.co_freevars == code.co_freevars for function, code in swaps)
        return swaps if possible else []

    def run_swapped(self, swaps: list[tuple[FunctionType, CodeType]], names: list[str]) -> bool:
        """Run the tests ``names`` with the changed code of ``swaps``; True if all pass."""
        for function, code in swaps:
            function.__code__ = code
        return len(self.run_rows(names, stop=not self.options.matrix)) == len(names)

    def run_new(self, file: str, text: bytes) -> None:
        """Run all rows but ``failing`` with a changed file, in a new process where pytest writes which fail."""
        (self.tree / file).write_bytes(text)
        os.utime(self.tree / file, (0, 0))  # so that no .pyc file is taken for it
        os.dup2(os.open(self.failed, os.O_WRONLY), 1)
        options = ["--tb=no", "-rfE", f"--maxfail={int(not self.options.matrix)}"]  # 0: no limit, find all killers
        options += [f"--deselect={name}" for name in self.failing]
        os.execv(sys.executable, [sys.executable, "-m", "pytest", *options, *self.arguments])  # noqa: S606


def report(file: str, possible: int, records: list[dict[str, Any]]) -> None:
    """Print how many mutants were killed, with a count of their own for calls that log, and list the others."""
    results = [f"log {record['result']}" if ":log:" in record["name"] else record["result"] for record in records]
    counts = Counter(results)
    seconds = sum(record["seconds"] for record in records) / max(1, len(records))
    print(f"{file}: {len(records)} of {possible} mutants: {dict(counts)}; {seconds:.2f} s each")
    for record in sorted(records, key=lambda record: record["line"]):
        if record["result"] != "killed":
            print("  line {line}: {change}; {result}, {rows} rows; {name}".format(**record))


def compare(before: Iterable[str], after: Iterable[str]) -> int:
    """Print each mutant that was killed before but is not now; return 1 if there is one."""
    killed = {record["name"]: record for record in map(json.loads, before) if record["result"] == "killed"}
    now = [record for record in map(json.loads, after) if record["name"] in killed]
    lost = [record for record in now if record["result"] != "killed"]
    for record in lost:
        print("line {line}: {change}; {result} now, {rows} rows; {name}".format(**record))
    if len(now) < len(killed):
        print(f"{len(killed) - len(now)} mutants that were killed before were not tried now")
    return int(bool(lost))


def spare(results: Iterable[Iterable[str]]) -> int:
    """Print the test functions that can be removed together: others cover all their arcs and kill all their mutants."""
    records = (json.loads(line) for lines in results for line in lines)
    # for each arc and each mutant: the functions that are left to cover or kill it
    needs = [{name.partition("[")[0] for name in record["killers"]} for record in records]
    counts = Counter(itertools.chain.from_iterable(needs))
    for function in sorted(counts, key=lambda function: (counts[function], function)):
        having = [need for need in needs if function in need]
        if all(len(need) > 1 for need in having):
            print(function)
            for need in having:
                need.remove(function)
    return 0


def main() -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="a file of the tree in this folder")
    parser.add_argument("--tests", nargs="+", metavar="PATH", help="what to run (default: tests that import a FILE)")
    parser.add_argument("--thorough", action="store_true", help="run rows marked thorough, too; never page and alone")
    parser.add_argument("--n", type=int, default=30, help="mutants for each FILE, drawn at random (30; 0: all)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (1)")
    parser.add_argument("--matrix", action="store_true", help="find all killers of a mutant, for --spare (with --n 0)")
    parser.add_argument("--out", type=ROOT.joinpath, default="build/mutants/last.jsonl", help="results (%(default)s)")
    parser.add_argument("--compare", nargs=2, type=argparse.FileType(), metavar=("A", "B"), help="what only A killed")
    parser.add_argument("--spare", nargs="+", type=argparse.FileType(), metavar="OUT", help="tests that may go")
    options = parser.parse_args()
    if options.compare or options.spare:
        return compare(*options.compare) if options.compare else spare(options.spare)
    for path in options.files:
        if not (path.is_file() and path.suffix in (".py", ".js") and path.resolve().is_relative_to(ROOT)):
            sys.exit(f"mutate.py: {path} is no Python file or page module below {ROOT}")
    files = [str(path.resolve().relative_to(ROOT)) for path in options.files]
    tests = options.tests or tests_that_import(files)
    if not tests:
        sys.exit(f"mutate.py: no test imports {files}: name tests with --tests")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="m", ignore_cleanup_errors=True) as work:
        return Trial(files, tests, Path(work).resolve(), options).run()


if __name__ == "__main__":
    sys.exit(main())

"""Asks OSV (api.osv.dev) for known vulnerabilities of the packages in requirements/, through pip-audit.

It succeeds only if every package was looked up and none has one. Without an answer about all of them it ends with
"not checked" and code 3; with vulnerabilities it names them and ends with code 1.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILES = ("requirements/dev.txt", "requirements/tools.txt")  # the first has all packages of the others
CLEAN, VULNERABLE, NOT_CHECKED = 0, 1, 3
_PIN = re.compile(r"^([a-z0-9][a-z0-9._-]*)==", re.MULTILINE)


def pinned(text: str) -> set[str]:
    """The packages of a file with requirements."""
    return set(_PIN.findall(text))


def judge(file: str, pins: set[str], answer: str, log: str) -> tuple[int, list[str]]:
    """What pip-audit's ``answer`` (JSON) and ``log`` mean for the packages of ``file``: a code and lines to print."""
    try:
        packages = json.loads(answer)["dependencies"]
        found = {_normal(package["name"]): package["vulns"] for package in packages if "vulns" in package}
    except (ValueError, KeyError, TypeError):
        reason = (log.strip().splitlines() or ["pip-audit answered nothing"])[-1]
        return NOT_CHECKED, [f"not checked: {file}: {reason}"]
    lines = [
        f"{file}: {name}: {one['id']}, mended in {', '.join(one.get('fix_versions') or ['no version yet'])}"
        for name, ones in found.items()
        for one in ones
    ]
    if missing := sorted(pins - found.keys()):
        return NOT_CHECKED, [*lines, f"not checked: {file}: no answer about {', '.join(missing)}"]
    if lines:
        return VULNERABLE, lines
    return CLEAN, [
        f"{file}: no known vulnerability in {len(found)} packages; libraries inside wheels were not looked at"
    ]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def main() -> int:
    codes = []
    for file in FILES:
        command = [sys.executable, "-m", "pip_audit", "--requirement", file, "--require-hashes", "--disable-pip"]
        command += ["--vulnerability-service", "osv", "--format", "json", "--progress-spinner", "off"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        code, lines = judge(file, pinned((ROOT / file).read_text()), done.stdout, done.stderr)
        print("\n".join(lines), flush=True)
        codes.append(code)
    return next(code for code in (VULNERABLE, NOT_CHECKED, CLEAN) if code in codes)


if __name__ == "__main__":
    sys.exit(main())

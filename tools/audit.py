"""Asks OSV (api.osv.dev) for known vulnerabilities of the packages in requirements.txt, through pip-audit.

It fails only if a package has one. Packages about which there is no answer are named as not checked.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

LOCK = Path(__file__).resolve().parent.parent / "requirements.txt"
_PIN = re.compile(r"^([a-z0-9][a-z0-9._-]*)==", re.MULTILINE)


def judge(pins: set[str], answer: str, log: str) -> tuple[int, list[str]]:
    """Return the exit code and the lines to print for pip-audit's ``answer`` (JSON) about ``pins``, and its ``log``."""
    try:
        packages = json.loads(answer)["dependencies"]
        found = {re.sub(r"[-_.]+", "-", one["name"]).lower(): one["vulns"] for one in packages if "vulns" in one}
    except (ValueError, KeyError, TypeError):
        return 0, [f"not checked: {(log.strip().splitlines() or ['pip-audit answered nothing'])[-1]}"]
    lines = [
        f"{name}: {flaw['id']}, mended in {', '.join(flaw.get('fix_versions') or ['no version yet'])}"
        for name, flaws in found.items()
        for flaw in flaws
    ]
    code = 1 if lines else 0
    if missing := sorted(pins - found.keys()):
        lines.append(f"not checked: no answer about {', '.join(missing)}")
    return code, lines or [
        f"no known vulnerability in {len(found)} packages; libraries inside wheels were not looked at"
    ]


def main() -> int:
    command = [sys.executable, "-m", "pip_audit", "--requirement", str(LOCK), "--require-hashes", "--disable-pip"]
    command += ["--vulnerability-service", "osv", "--format", "json", "--progress-spinner", "off"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    code, lines = judge(set(_PIN.findall(LOCK.read_text())), done.stdout, done.stderr)
    print("\n".join(lines))
    return code


if __name__ == "__main__":
    sys.exit(main())

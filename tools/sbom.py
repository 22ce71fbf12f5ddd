"""Writes build/sbom.cdx.json: what a robot with the operator page consists of, as CycloneDX 1.6.

Python packages are those that requirements.txt has for a robot, by cyclonedx-py; the page's JavaScript is that of its
vendor.json. Libraries inside wheels are not in it: docs/licences.md names them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
VENDOR = ROOT / "pebble/extensions/page/static/vendor/vendor.json"
SBOM = ROOT / "build" / "sbom.cdx.json"


def vendored(entries: list[dict[str, str]]) -> list[dict[str, Any]]:
    """Return the components of npm's packages, each once, with their files."""
    packages: dict[str, dict[str, Any]] = {}
    for entry in entries:
        purl = f"pkg:npm/{entry['name'].replace('@', '%40')}@{entry['version']}"
        package = packages.setdefault(
            purl,
            {
                "type": "library",
                "bom-ref": purl,
                "name": entry["name"],
                "version": entry["version"],
                "purl": purl,
                "licenses": [{"license": {"id": entry["licence"]}}],
                "components": [],
            },
        )
        digest = {"alg": "SHA-256", "content": entry["sha256"]}
        package["components"].append({"type": "file", "name": entry["file"], "hashes": [digest]})
    return list(packages.values())


def main() -> None:
    """Write the SBOM; ends the program if cyclonedx-py fails."""
    command = [sys.executable, "-W", "ignore::UserWarning", "-m", "cyclonedx_py", "requirements"]
    command += ["--pyproject", "pyproject.toml", "--output-reproducible", "--spec-version", "1.6"]
    packages = subprocess.run(["sh", "tools/locked.sh", "robot"], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    done = subprocess.run([*command, "-"], cwd=ROOT, input=packages, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        sys.exit("no SBOM: cyclonedx-py failed, see above")
    sbom = json.loads(done.stdout)
    sbom["components"] += vendored(json.loads(VENDOR.read_text()))
    SBOM.parent.mkdir(exist_ok=True)
    SBOM.write_text(json.dumps(sbom, indent=1) + "\n")
    print(f"{SBOM.relative_to(ROOT)}: {len(sbom['components'])} components")


if __name__ == "__main__":
    main()

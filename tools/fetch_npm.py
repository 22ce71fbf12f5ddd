"""Downloads what only tests use from npm's registry, each into a folder of its own unless it is there.

fetch_npm.py FOLDER [NAME …]       all of them, or those named, into FOLDER/NAME
"""

import sys
from pathlib import Path
from typing import NamedTuple

import npm


class Package(NamedTuple):
    """What is taken from one package; ``sha512`` is npm's own "integrity" of this version."""

    name: str
    version: str
    sha512: str
    files: tuple[str, ...]
    purpose: str


PACKAGES = {
    "micropython": Package(
        "@micropython/micropython-webassembly-pyscript",
        "1.29.0-6",
        "kLwGPJFsLY/2aUPmzZxpvauFSmKc0SlJWVvvEttULR0poVQ6W9HV//1fUJyxrGWAxCVDw9aYqJ0LAog0ZLjYVA==",
        ("micropython.mjs", "micropython.wasm", "package.json"),
        "MicroPython for Node.js",
    ),
    "axe": Package(
        "axe-core",
        "4.14.1",
        "FHfa+lmNjQZfJz1q8wKqIDwC6DExcHt/pkjNQb09a3NPjCKg2rhu5qb2S4r76ASyFNNtuFooJpZe37OgudVGtQ==",
        ("axe.min.js",),
        "axe-core, which checks the operator page for accessibility",
    ),
    "typescript": Package(
        "typescript",
        "5.9.3",
        "jl1vZzPDinLr9eUt3J/t7V6FgNEw9QjvBPdysz9KfQDD41fQrC2Y4vKQdiaUpFT4bXlb1RHhLpp8wtm6M5TgSw==",
        ("lib/tsc.js", "lib/_tsc.js", "lib/lib.*", "package.json"),
        "TypeScript, which checks the types of the operator page",
    ),
    "asyncapi": Package(
        "@asyncapi/parser",
        "3.6.6",
        "DppE3OStajt6gHc+RsVf9VxRwW9WACagHnFvkOML5rZGwS9hXxtFYTxnsH3mHPRgHom0rClMs6DpbjNY65Y54A==",
        ("browser/index.js",),
        "AsyncAPI's own parser, which checks docs/asyncapi.yaml",
    ),
    "mqtt": Package(
        "mqtt",
        "5.16.0",
        "G0VsEtuJz5sJUgZJaaADMVfW7SIFPzkIuHR+d6rk+tBeSwdCfd9BaIRycRfd2AbyFDEmLlFM+SDQeti/+IbOnw==",
        ("dist/mqtt.esm.js", "package.json"),
        "MQTT.js, for the robot in JavaScript",
    ),
    "node_modules/@foxglove/ws-protocol": Package(
        "@foxglove/ws-protocol",
        "0.8.0",
        "Wh3dlmgoCr3D9D8c3Wk2GXvyMiftScItFT6LKK1apJZagElod2PQBPdyVN/GXATOvavKhw97eMGrcDTU7vekVw==",
        ("dist/cjs/*", "package.json"),
        "Foxglove's own client, which tests the live connection",
    ),
    "node_modules/eventemitter3": Package(
        "eventemitter3",
        "5.0.4",
        "mlsTRyGaPBjPedk6Bvw+aqbsXDtoAyAzm5MO7JgU+yVRyMQ5O8bD4Kcci7BS85f93veegeCPkL8R4GLClnjLFw==",
        ("index.js", "package.json"),
        "what Foxglove's client is built on",
    ),
    "node_modules/tslib": Package(
        "tslib",
        "2.9.1",
        "a4Ux9VKuIMHsOS7ENbEq6hK2ZGYIT27Rtl0E4eD9KqwxhKiQeMZE/9xb3IdYwWaSOyIBQLExhQgXDTYoiCxnWA==",
        ("tslib.js", "package.json"),
        "what Foxglove's client and @mcap/core are built on",
    ),
    "node_modules/ws": Package(
        "ws",
        "8.23.0",
        "wCkmX8QMOrKjgO8HW2WyDbTSGeqkocxgDzS9iR79rEAexty6/2qzilx3Ag8Tqf9ykop3irLKle0MtVn5qjVnoQ==",
        ("index.js", "lib/*", "package.json"),
        "WebSockets for Node.js",
    ),
    "node_modules/@mcap/core": Package(
        "@mcap/core",
        "2.2.2",
        "W4NFiyqQlJsNjw8JxAAQ872u0xLWJy0GFC3YFm8bTLbNs+HdDWe8DwBqznr0MGYpWtw+AX8XzHWB5Y9rLEGJJg==",
        ("dist/cjs/*", "package.json"),
        "@mcap/core, which reads recordings in a browser",
    ),
    "node_modules/@foxglove/crc": Package(
        "@foxglove/crc",
        "0.0.3",
        "DjIZsnL3CyP/yQ/vUYA9cjrD0a/8YXejI5ZmsaOiT16cLfZcTwaCxIN01/ys4jsy+dZCQ/9DnWFn7AEFbiMDaA==",
        ("dist/cjs/src/*", "package.json"),
        "what @mcap/core is built on",
    ),
    "node_modules/heap-js": Package(
        "heap-js",
        "2.7.1",
        "EQfezRg0NCZGNlhlDR3Evrw1FVL2G3LhU7EgPoxufQKruNBSYA8MiRPHeWbU+36o+Fhel0wMwM+sLEiBAlNLJA==",
        ("dist/heap-js.umd.js", "package.json"),
        "what @mcap/core is built on",
    ),
    "node_modules/fzstd": Package(
        "fzstd",
        "0.1.1",
        "dkuVSOKKwh3eas5VkJy1AW1vFpet8TA/fGmVA5krThl8YcOVE/8ZIoEA1+U1vEn5ckxxhLirSdY837azmbaNHA==",
        ("lib/index.js", "package.json"),
        "Zstandard for @mcap/core",
    ),
}


def main(folder: Path, names: list[str]) -> None:
    for name in names or PACKAGES:
        get(PACKAGES[name], folder / name)


def get(package: Package, folder: Path) -> None:
    there = folder / "version"
    if there.exists() and there.read_text() == package.version:
        return
    print(f"pebble: fetching {package.purpose}")
    content = npm.tarball(package.name, package.version, package.sha512)
    for wanted in package.files:
        for path, file in npm.members(content, wanted).items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file)
    there.write_text(package.version)  # last: an interrupted run is repeated


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])

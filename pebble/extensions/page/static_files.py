"""The files of the page, read once at the start; no other file can be requested."""

import base64
import gzip
import hashlib
import posixpath
import re
from collections.abc import Iterator
from importlib.resources.abc import Traversable

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from pebble.extensions.page.access.guard import CONTENT_SECURITY_POLICY

NO_STORE = {"cache-control": "no-store"}
FOREVER = {"cache-control": "public, max-age=31536000, immutable"}

_TYPES = {
    "css": "text/css; charset=utf-8",
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "mjs": "text/javascript; charset=utf-8",
    "png": "image/png",
    "svg": "image/svg+xml",
    "webmanifest": "application/manifest+json",
    "woff2": "font/woff2",
}
_COMPRESSED = {"png", "woff2"}  # by their format: they are neither stripped nor compressed again
_VERSION = b"{version}"  # in the pages, replaced by that of the files
_ROOT = b"{root}"  # replaced by root_of(): a proxy may show the server below a path that only browsers know
_START = b"{start}"  # replaced by start.js, which needs no request of its own
_MODULES = b"{modules}"  # replaced by links to all that is imported: browsers need not discover them one by one
#: The page of each screen, made from index.html, and the screen's module.
_SCREENS = {"fleet.html": "ui/fleet/fleet.js", "robot.html": "ui/robot/robot.js"}
_SHEETS = {"fleet.html": "fleet.css"}  # that the screen needs beside app.css
_IMPORT = re.compile(rb'^(?:import|export|\}).*?"(\.\.?/[^"]+)";?$', re.MULTILINE)
_AGAIN = re.compile(r"\.\d{1,4}")  # after the version: the same files once more, for a page that has lost one
_COMMENTS = re.compile(r"^[ \t]*(?:/\*.*?\*/|//[^\n]*)[ \t]*$", re.MULTILINE | re.DOTALL)
_CASTS = re.compile(r"/\*\* @[^\n]*?\*/ ")  # comments with types, within a line
_LINE_ENDS = re.compile(r"(?<=\S)[ \t]+//[ ][^\"'`\n]*$", re.MULTILINE)  # one with quotes may be the end of a string
_LOOSE = re.compile(r" (?=\{$)|(^[\w-]+:) |;\n(?=})|(?<=[{};,])\n|(?<=,) ", re.MULTILINE)  # needless in style sheets
_INDENTATION = re.compile(r"^\s+", re.MULTILINE)


class StaticFiles:
    """All files below one folder. ``version`` changes with any of them, and is part of their addresses."""

    def __init__(self, root: Traversable) -> None:
        self.files = dict(sorted(_read(root, "")))  # by name: the contents
        digest = hashlib.sha256()
        for name, content in self.files.items():
            digest.update(f"{name}\0{len(content)}\0".encode() + content)
        self.version = digest.hexdigest()[:12]
        start = self.files.pop("start.js").strip()  # browsers run it within the page, as the policy has its hash
        hashed = f"'sha256-{base64.b64encode(hashlib.sha256(start).digest()).decode()}'"
        self._policy = CONTENT_SECURITY_POLICY.replace("script-src", f"script-src {hashed}")
        index = self.files.pop("index.html").replace(_START, start)
        for name, screen in _SCREENS.items():
            self.files[name] = index.replace(_MODULES, self._links(name, screen))
        for name in self.files:
            if name.endswith(".html"):
                self.files[name] = self.files[name].replace(_VERSION, self.version.encode())
        self._first = {"main.js", *self._imported("main.js")}  # run at the start of each screen: see answer()
        self._packed = {name: _packed(name, content) for name, content in self.files.items()}

    def _links(self, name: str, screen: str) -> bytes:
        """Return the links for the page ``name`` to all that its module ``screen`` needs, the style sheet first."""
        modules = (screen, *self._imported("main.js", screen))
        links = [b'<link rel="modulepreload" href="{root}static/{version}/%s">' % path.encode() for path in modules]
        if name in _SHEETS:
            sheet = _SHEETS[name].encode()
            links.insert(0, b'<link rel="preload" as="style" href="{root}static/{version}/%s">' % sheet)
        return b"\n".join(links)

    def _imported(self, *names: str) -> list[str]:
        """Return the modules that the modules ``names`` import before they run, also indirectly."""
        modules = list(names)
        for name in modules:  # it grows meanwhile
            for path in _IMPORT.findall(self.files.get(name, b"")):
                imported = _imported_name(name, path)
                if imported not in modules:
                    modules.append(imported)
        return modules[len(names) :]

    def page(self, request: Request) -> Response:
        """Return the operator page. Its address decides which screen it shows."""
        # with no-referrer, browsers do not say where a form comes from
        headers = {**NO_STORE, "content-security-policy": self._policy, "referrer-policy": "same-origin"}
        name = "robot.html" if request.url.path.startswith("/r/") else "fleet.html"
        content = self.files[name].replace(_ROOT, root_of(request).encode())
        return _response(request, name, content, _packed(name, content), headers)

    def is_current(self, version: str) -> bool:
        """True if the version in an address is that of the files."""
        return _AGAIN.sub("", version) == self.version

    def answer(self, request: Request, name: str, headers: dict[str, str]) -> Response:
        """Return the file ``name``, compressed if the browser accepts that; 404 if there is none.

        If the page asks again for a module because one of its imports was lost, it adds a number as query. The query is
        then added to the module's imports too, except to the modules of the page's start: they must not run twice.
        """
        if name not in self.files:
            return PlainTextResponse("not found", 404)
        # Of the number four digits do: any client may send a longer one, and it is added to each import.
        if (query := request.scope.get("query_string", b"")).isdigit():
            content = _IMPORT.sub(lambda statement: self._renewed(name, statement, query[:4]), self.files[name])
            return _response(request, name, content, _packed(name, content), headers)
        return _response(request, name, self.files[name], self._packed[name], headers)

    def _renewed(self, name: str, statement: re.Match[bytes], query: bytes) -> bytes:
        """Return an import statement of the module ``name`` with the query added to its path."""
        path = statement[1]
        if _imported_name(name, path) in self._first:
            return statement[0]
        return statement[0].replace(path, path + b"?" + query)


def _imported_name(module: str, path: bytes) -> str:
    """Return the name of the file that a module imports by a relative path."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(module), path.decode()))


def root_of(request: Request) -> str:
    """Return the relative path from a request's address to the server's root: ``./``, ``../../``."""
    path: bytes = request.scope["raw_path"]
    return "../" * (path.count(b"/") - 1) or "./"


def _packed(name: str, content: bytes) -> bytes | None:
    """Return the content compressed by gzip; None if its format is compressed already."""
    return None if name.rpartition(".")[2] in _COMPRESSED else gzip.compress(content, 9, mtime=0)


def _response(request: Request, name: str, content: bytes, packed: bytes | None, headers: dict[str, str]) -> Response:
    headers = {**headers, "vary": "accept-encoding"}
    if packed is not None and "gzip" in request.headers.get("accept-encoding", ""):
        content, headers["content-encoding"] = packed, "gzip"
    return Response(content, media_type=_TYPES[name.rpartition(".")[2]], headers=headers)


def _read(folder: Traversable, path: str) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of each file; ``path``: what its name begins with."""
    for entry in folder.iterdir():
        suffix = entry.name.rpartition(".")[2]
        if entry.is_dir():
            yield from _read(entry, f"{path}{entry.name}/")
        elif suffix in _TYPES:
            content = entry.read_bytes()
            yield path + entry.name, content if suffix in _COMPRESSED else stripped(content, suffix)


def stripped(source: bytes, suffix: str) -> bytes:
    """Return a file without comments, indentation and empty lines, which makes it a sixth smaller.

    In style sheets other needless blanks are removed as well.
    """
    text = source.decode()
    if suffix in ("css", "js", "mjs"):
        text = _COMMENTS.sub("", text)
    if suffix in ("js", "mjs"):
        text = _LINE_ENDS.sub("", _CASTS.sub("", text))
    text = _INDENTATION.sub("", text)
    return (_LOOSE.sub(r"\1", text) if suffix == "css" else text).encode()

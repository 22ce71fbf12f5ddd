"""The operator page: a process between browsers and the remote broker, and the page that it serves."""

from pebble.extension import Command, Extension, Program

EXTENSION = Extension(
    name="page",
    needs=("operator", "media", "fleet", "recordings"),
    extra="web",
    packages=("uvicorn", "starlette"),
    sections={
        "services.web_handler": "pebble.extensions.page.config:WebHandler",
        "web_interface": "pebble.extensions.page.config:WebInterface",
    },
    rules="pebble.extensions.page.config:RULES",
    program=Program("web_handler", "pebble.extensions.page.run", preloaded=False),
    commands={
        "drive": Command(
            "pebble.extensions.page.commands.drive:drive", "drive a robot with the keys of this terminal", "use", 20
        ),
        "web": Command("pebble.extensions.page.commands.group", "drive, stop and watch robots in a browser", "use", 50),
        "cert": Command(
            "pebble.extensions.page.commands.cert", "make certificates, so that phones may connect", "share", 20
        ),
    },
    page="docs/ext/page.md",
)

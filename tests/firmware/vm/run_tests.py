"""In MicroPython: every test of /module.txt's module, one line of JSON each."""

import io
import json
import sys

with open("/module.txt") as file:
    module = __import__(file.read())
for name in dir(module):
    if name.startswith("test_"):
        error = ""
        try:
            getattr(module, name)()
        except Exception as problem:
            text = io.StringIO()
            sys.print_exception(problem, text)
            error = text.getvalue()
        print(json.dumps([name, error]))

"""In MicroPython: every test of the modules in /modules.json, one line of JSON each; a module at each turn."""

import io
import json
import sys

with open("/modules.json") as file:
    waiting = json.load(file)


def turn():
    name = waiting.pop()
    module = __import__(name)
    for test in dir(module):
        if test.startswith("test_"):
            error = ""
            try:
                getattr(module, test)()
            except Exception as problem:
                text = io.StringIO()
                sys.print_exception(problem, text)
                error = text.getvalue()
            print(json.dumps([name, test, error]))
    return bool(waiting)

"""Marshalled lambdas of one Python, as Keras stores them; run once with each interpreter, Python 2.7 included:

    for python in python2.7 python3.6 ... python3.13; do $python make_lambdas.py; done > lambdas.jsonl

Each line: Python version, source, code as hexadecimal digits, and y = x * factor + offset, or null where it is no such function.
"""

from __future__ import print_function

import binascii
import json
import marshal
import sys

CASES = [
    ("lambda x: x/127.5 - 1.", 1 / 127.5, -1),
    ("lambda x: x/255.0 - 0.5", 1 / 255.0, -0.5),
    ("lambda x: (x / 255.) - .5", 1 / 255.0, -0.5),
    ("lambda image: image * 0.25 + 3", 0.25, 3),
    ("lambda x: (x - 128.0) / 128", 1 / 128.0, -1),
    ("lambda x: -1.0 + x / 127.5", 1 / 127.5, -1),
    ("lambda x: 2 * (x / 255.0 - 0.5)", 2 / 255.0, -1),
    ("lambda x: -x", -1, 0),
    ("lambda x: x", 1, 0),
    ("lambda x: x / (255 * 0.5) - 1", 1 / 127.5, -1),
    ("lambda x: x / 0 - 1", None, None),
    ("lambda x: x * x", None, None),
    ("lambda x: 1.0 / x", None, None),
    ("lambda x: x - x", 0, 0),
    ("lambda x: x ** 2", None, None),
    ("lambda x: resize(x, (66, 200))", None, None),
    ("lambda x: x[:, 60:135] / 255.0", None, None),
    ("lambda x, a=127.5: x / a - 1", None, None),
    ("lambda x: x / 255.0 if x is None else x", None, None),
    ("lambda x: __import__('os').system('false')", None, None),
    ("def f(x):\n    y = x / 255.0\n    shift = 0.5\n    y = y - shift\n    return y * 2", 2 / 255.0, -1),
    ("def f(x):\n    if x is None:\n        y = x\n    return y / 2", None, None),
]

for source, factor, offset in CASES:
    names = {}
    exec(source if source.startswith("def") else "f = " + source, names)
    code = binascii.hexlify(marshal.dumps(names["f"].__code__)).decode("ascii")
    line = [("python", "%d.%d" % sys.version_info[:2]), ("source", source), ("code", code), ("factor", factor), ("offset", offset)]
    print("{%s}" % ", ".join("%s: %s" % (json.dumps(key), json.dumps(value)) for key, value in line))

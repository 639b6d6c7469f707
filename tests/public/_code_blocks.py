"""Code blocks of a document: found and run; their output is compared."""

import contextlib
import io
import re

import jax
from sybil import Document
from sybil.parsers.markdown import CodeBlockParser


class Blocks(CodeBlockParser):
    """Code blocks of one language, as text."""

    def evaluate(self, example):
        raise NotImplementedError


def blocks(path):
    """(line, language, text) of a document's Python and text blocks, in order."""
    document = Document.parse(str(path), Blocks("python"), Blocks("text"))
    found = {}
    for example in document:
        language = re.match(r"```(\w+)", document.text[example.start :]).group(1)
        found[example.line] = (language, example.parsed)
    return [(line, *found[line]) for line in sorted(found)]


def run(name, found, namespace):
    """Run the Python blocks in one namespace; returns how many text blocks equal the output."""
    printed, compared = "", 0
    for line, language, text in found:
        if language == "python":
            out = io.StringIO()
            # optax needs JAX's standard promotion of dtypes.
            kind = "standard" if "import optax" in text else "strict"
            with contextlib.redirect_stdout(out), jax.numpy_dtype_promotion(kind):
                exec(compile(text, f"{name}:{line}", "exec"), namespace)
            printed = out.getvalue()
        else:
            assert printed.strip() == str(text).strip(), f"{name}:{line}"
            compared += 1
    return compared

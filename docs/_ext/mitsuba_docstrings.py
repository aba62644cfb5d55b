"""Docstrings as this library writes them.

* Plugin classes have Mitsuba's own form: ``.. pluginparameters::`` (a table of name, type and
  meaning), ``.. tabs::`` with ``.. code-tab::``, ``:monosp:``, ``|float|``, and references to
  plugins of Mitsuba's, which become links to its documentation.
* All others are plain text. Paragraphs are kept as paragraphs; what is indented or aligned in
  columns is kept as it stands.
"""

import re

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.parsers.rst.directives.tables import ListTable

_MITSUBA = "https://mitsuba.readthedocs.io/en/stable/src/generated/plugins_{}.html"
_PAGES = {"integrator": "integrators", "bsdf": "bsdfs", "emitter": "emitters"}
_TYPES = ("string", "float", "bool", "int", "spectrum", "texture", "true", "false")


class PluginParameters(ListTable):
    """Mitsuba's table of parameters, under the headings that it has there."""

    def run(self):
        self.options |= {"widths": [18, 17, 65], "header-rows": 1, "class": ["plugin-parameters"]}
        for line in ("     - Description", "     - Type", "   * - Parameter"):
            self.content.insert(0, line.removeprefix("   "), source="pluginparameters")
        return super().run()


class Tabs(Directive):
    """One block of code after the other."""

    has_content = True

    def run(self):
        box = nodes.container()
        self.state.nested_parse(self.content, self.content_offset, box)
        return box.children


class CodeTab(Directive):
    has_content = True
    required_arguments = 1

    def run(self):
        code = "\n".join(self.content)
        return [nodes.literal_block(code, code, language=self.arguments[0])]


def _link_to_mitsuba(app, env, node, content):
    kind, _, name = node.get("reftarget", "").partition("-")
    if node.get("reftype") != "ref" or kind not in _PAGES:
        return None
    link = nodes.reference("", "", internal=False, refuri=_MITSUBA.format(_PAGES[kind]))
    link += nodes.literal(name, node.astext() or name)
    return link


# What a paragraph may contain as markup; everything else is text.
_MARKUP = re.compile(r"(``.+?``|:\w+:`[^`]+`|(?<!\w)\*[A-Za-z][^*]*\w\*(?!\w))", re.DOTALL)


def _escape(text):
    parts = _MARKUP.split(text)
    return "".join(p if k % 2 else re.sub(r"([\\*|_`])", r"\\\1", p) for k, p in enumerate(parts))


def _plain_to_rst(app, what, name, thing, options, lines):
    if any(line.strip().startswith(".. pluginparameters::") for line in lines):
        return
    paragraphs = "\n".join(lines).rstrip().removesuffix("::").rstrip().split("\n\n")
    found = []
    for paragraph in paragraphs:
        rows = paragraph.splitlines()
        aligned = any(row.startswith(" ") or re.search(r"\S {2,}\S", row) for row in rows)
        if rows and aligned:
            rows = [row.replace("``", "") for row in rows]
            found += ["::", "", *(f"    {row}".rstrip() for row in rows), ""]
        elif rows and all(row.startswith("* ") or row.startswith("  ") for row in rows):
            found += [*rows, ""]
        else:
            found += [*_escape(paragraph).splitlines(), ""]
    lines[:] = found


def _skip(app, what, name, thing, skip, options):
    """Fields of named tuples have docstrings that nobody wrote."""
    written = str(getattr(thing, "__doc__", "") or "")
    return True if written.startswith("Alias for field number") else None


def setup(app):
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("tabs", Tabs)
    app.add_directive("code-tab", CodeTab)
    app.add_generic_role("monosp", nodes.literal)
    app.connect("autodoc-skip-member", _skip)
    app.connect("missing-reference", _link_to_mitsuba)
    app.connect("autodoc-process-docstring", _plain_to_rst)
    types = "".join(f".. |{name}| replace:: {name}\n" for name in _TYPES)
    app.config.rst_prolog = types
    return {"parallel_read_safe": True}

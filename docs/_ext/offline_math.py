"""Equations as MathML, which browsers show by themselves: no JavaScript, no network. docutils does
the conversion.
"""

import html
import re
import xml.etree.ElementTree as ET
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)
_NAMESPACE = "{http://www.w3.org/1998/Math/MathML}"
_ACCENTS = tuple("\u02d9\u00a8\u02c6\u02dc~\u00af")  # dot, two dots, hat, tildes, bar
_BARS = ("|", "\u2223", "\u2225", "\u2016")
# a fraction of single characters, such as \tfrac12, which docutils reads as 12 over the next token
_FRACTION = re.compile(r"(\\[td]?frac)\s*([^\s{}\\])\s*([^\s{}\\])")


def _mathml(node: nodes.Node, *, block: bool) -> str:
    try:
        text = _FRACTION.sub(r"\1{\2}{\3}", node.astext())
        return _tidied(tex2mathml(text, as_block=block))
    except (
        MathError,
        AttributeError,
        IndexError,
        KeyError,
        SyntaxError,
        ValueError,
    ) as error:  # malformed: it may raise any
        logger.warning("equation cannot be converted: %s", error, location=node)
        return f"<code>{nodes.unescape(node.astext())}</code>"


def _tidied(mathml: str) -> str:
    """Subscripts of accented letters beside them rather than below, bars without the space of an
    operator.
    """
    ET.register_namespace("", _NAMESPACE.strip("{}"))
    # XML knows none of HTML's named characters but these.
    root = ET.fromstring(
        re.sub(r"&(?!lt;|gt;|amp;|#)\w+;", lambda found: html.unescape(found.group()), mathml)
    )
    for element in list(root.iter()):
        tag = element.tag.removeprefix(_NAMESPACE)
        if tag == "munderover" and element[2].text in _ACCENTS:
            letter, below, accent = element
            element[:] = [ET.Element(f"{_NAMESPACE}mover", accent="true"), below]
            element[0].extend([letter, accent])
            element.tag = f"{_NAMESPACE}msub"
        elif tag == "mover" and element[1].text in _ACCENTS:
            element.set("accent", "true")
        elif tag == "mo" and element.text in _BARS:
            element.attrib.update(lspace="0", rspace="0")
    return ET.tostring(root, encoding="unicode")


def _visit_inline(translator: Any, node: nodes.Node) -> None:
    translator.body.append(_mathml(node, block=False))
    raise nodes.SkipNode


def _visit_block(translator: Any, node: nodes.Element) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    translator.body.append(
        translator.starttag(node, "div", CLASS="equation")
        + number
        + _mathml(node, block=True)
        + "</div>\n"
    )
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    app.connect("config-inited", lambda _, config: setattr(config, "html_math_renderer", "mathml"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

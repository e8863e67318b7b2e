"""Formulas of the pages as MathML: `$...$` in a line, `$$...$$` as a block.

Code hosts draw the same notation. Browsers draw MathML themselves, so the site needs no script
and no request to another server.
"""

import re
from typing import Any, Final
from xml.etree.ElementTree import Element

from latex2mathml.converter import convert_to_element
from markdown import Extension, Markdown
from markdown.blockparser import BlockParser
from markdown.blockprocessors import BlockProcessor
from markdown.inlinepatterns import InlineProcessor

BLOCK: Final = re.compile(r"\s*\$\$(?P<latex>.+)\$\$\s*", re.DOTALL)
INLINE: Final = r"\$(?![\s$])([^$\n]+?)(?<!\s)\$(?!\w)"
BEFORE_EMPHASIS, BEFORE_PARAGRAPHS = 170, 15


class InlineFormula(InlineProcessor):
    """A formula within a line; a price such as 5 $ is none."""

    def handleMatch(  # noqa: N802 - Python-Markdown's name
        self,
        m: re.Match[str],
        data: str,  # noqa: ARG002
    ) -> tuple[Element, int, int]:
        """Return the formula in the place of its text."""
        return convert_to_element(m[1]), m.start(0), m.end(0)


class BlockFormula(BlockProcessor):
    """A formula between blank lines."""

    def test(self, parent: Element, block: str) -> bool:  # noqa: ARG002
        """Return whether the block is a formula."""
        return BLOCK.fullmatch(block) is not None

    def run(self, parent: Element, blocks: list[str]) -> None:
        """Put the formula into the page."""
        if found := BLOCK.fullmatch(blocks.pop(0)):
            convert_to_element(found["latex"].strip(), display="block", parent=parent)


class MathMl(Extension):
    """Formulas as MathML."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802 - Python-Markdown's name
        """Recognise both kinds."""
        md.inlinePatterns.register(InlineFormula(INLINE, md), "formula", BEFORE_EMPHASIS)
        parser: BlockParser = md.parser
        parser.blockprocessors.register(BlockFormula(parser), "formula", BEFORE_PARAGRAPHS)


def makeExtension(**settings: Any) -> MathMl:  # noqa: N802 - Python-Markdown's name
    """Return the extension, by the name that Python-Markdown asks for."""
    return MathMl(**settings)

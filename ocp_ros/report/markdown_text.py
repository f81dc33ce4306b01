# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Texts of others in pages of Markdown: shown as they are, never obeyed."""

from html import escape
import re

from ocp_ros.util.shown_text import printable

#: What begins or ends markup within a line; an underscore between letters does not.
MARKS = re.compile(r'[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])|:(?=//)|(?<=www)\.|@')


def in_markdown(text: str) -> str:
    """Return a text as Markdown that shows it, in one line, within a paragraph or a table."""
    return MARKS.sub(r'\\\g<0>', escape(printable(text), quote=False))

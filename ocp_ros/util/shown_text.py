# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Texts of others, such as names of files, where people read them."""

#: Letters that only join or part others, as several scripts need them.
JOINERS = '\u200c\u200d'


def printable(text: str) -> str:
    """
    Return a text in one line that neither steers a terminal nor turns the order of letters.

    Bytes of a file's name that are no text, control characters and marks of direction are shown
    as their escapes; other blanks become spaces.
    """
    return ''.join(_shown(letter) for letter in text)


def _shown(letter: str) -> str:
    """Return a letter, or what stands for it."""
    if letter.isprintable() or letter in JOINERS:
        return letter
    return ' ' if letter.isspace() else letter.encode('unicode_escape').decode('ascii')

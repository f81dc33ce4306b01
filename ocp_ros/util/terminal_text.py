# Copyright 2026 The ocp_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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

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

"""Make untrusted text, such as file names, safe to print."""


def printable(text: str) -> str:
    """
    Return a text as one line without terminal control or text direction characters.

    Undecodable bytes of file names, control characters and text direction characters become
    hexadecimal escapes; tabs, line ends and other blanks become spaces.
    """
    return ''.join(_printable_letter(letter) for letter in text)


def _printable_letter(letter: str) -> str:
    """Return a letter, or its replacement if it is not printable."""
    # Several scripts need these invisible characters, which join or separate letters.
    if letter.isprintable() or letter in '\u200c\u200d':
        return letter
    return ' ' if letter.isspace() else letter.encode('unicode_escape').decode('ascii')

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

"""Settings of Sphinx, for ``make docs`` and for rosdoc2 (rosdoc2.yaml)."""

from pathlib import PurePosixPath
from posixpath import normpath
import re

project = 'ocp_ros'
copyright = 'The ocp_ros authors'  # noqa: A001 (Sphinx names it so)
html_theme = 'furo'
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.autosummary']
# rosdoc2 puts an index and copies of README, licence and so on beside these pages.
exclude_patterns = ['index.rst', 'standard_docs', '__*', '[A-Z]*.*']

# Pages are written as GitHub shows them: headings are anchors, and code is indented shell.
myst_heading_anchors = 4
highlight_language = 'none'

autodoc_default_options = {'members': True}
autodoc_member_order = 'bysource'
autodoc_typehints_format = 'short'

LINK = re.compile(r'(?<!!)\[([^\]]*)\]\((?!https?:)([^)#\s]+)([^)\s]*)\)')


def shown(app, docname, source):
    """Make a page ready for the site: Sphinx calls this with the text of each one."""
    text = source[0]
    source[0] = LINK.sub(lambda link: link_of_the_site(docname, link), text)
    if docname == 'index':
        source[0] += contents(text)


def link_of_the_site(docname, link):
    """Return a link of a page, or its text alone where it leaves docs/ and so the site."""
    target = normpath(str(PurePosixPath(docname).parent / link.group(2)))
    return link.group(1) if target.startswith('..') else link.group(0)


def contents(text):
    """Return a hidden table of contents of all pages that the index lists, by its headings."""
    parts = []
    for section in text.split('\n## ')[1:]:
        caption, _, body = section.partition('\n')
        pages = [target for _, target, _ in LINK.findall(body) if target.endswith('.md')]
        parts += ['', '```{toctree}', ':hidden:', f':caption: {caption}', '', *pages, '```', '']
    return '\n'.join(parts)


def setup(app):
    """Have Sphinx call :func:`shown`."""
    app.connect('source-read', shown)

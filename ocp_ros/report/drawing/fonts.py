# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fonts of pictures: that of matplotlib, and for letters that it lacks what is installed."""

from collections.abc import Iterator
from contextlib import contextmanager
import warnings

from matplotlib import font_manager, rc_context, rcParams

#: Fonts with Chinese, Japanese or Korean letters, as Linux, macOS and Windows have them.
FALLBACKS = ('Noto Sans CJK JP', 'Noto Sans CJK SC', 'Noto Sans CJK KR', 'Source Han Sans',
             'WenQuanYi Micro Hei', 'WenQuanYi Zen Hei', 'Droid Sans Fallback', 'IPAGothic',
             'NanumGothic', 'Hiragino Sans', 'PingFang SC', 'Apple SD Gothic Neo',
             'Microsoft YaHei', 'Yu Gothic', 'Malgun Gothic', 'Arial Unicode MS')


def families() -> list[str]:
    """Return the fonts to look for a letter in, one after the other."""
    installed = set(font_manager.fontManager.get_font_names())
    usual = list(rcParams['font.family'])
    return [*usual, *(name for name in FALLBACKS if name in installed and name not in usual)]


@contextmanager
def all_letters() -> Iterator[None]:
    """Write in fonts that together have as many letters as can be; others become boxes."""
    with rc_context({'font.family': families()}), warnings.catch_warnings():
        # Whoever looks at the page sees the boxes; docs/tasks/troubleshooting.md says what helps.
        warnings.filterwarnings('ignore', 'Glyph .* missing from font', UserWarning)
        yield

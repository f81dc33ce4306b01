# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures as files that are whole or absent."""

import io
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ocp_ros.util.files import write_atomically


def save_figure(figure: Figure, path: str | Path, **options: Any) -> None:
    """
    Write a figure, as PNG unless another format is named.

    :param path: file to write; its folder is made.
    :param options: of ``Figure.savefig``.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    picture = io.BytesIO()
    figure.savefig(picture, **{'format': 'png', **options})
    write_atomically(path, picture.getvalue())

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

"""Blobs of arrays, compared with the library of the format."""

import io
import json
import struct

import numpy as np
from ocp_ros.util.tensor_blob import read_blob, TYPES, write_blob
import pytest
import safetensors.numpy

ARRAYS = {'b': np.arange(6, dtype=np.float32).reshape(2, 3), 'scalar': np.array(3, np.int64),
          'none': np.empty((0, 4)), 'flags': np.array([True, False]),
          'turned': np.arange(6, dtype=np.int16).reshape(2, 3).T}


def blob_of(arrays, metadata=None):
    """Return the blob of arrays."""
    file = io.BytesIO()
    write_blob(file, arrays, metadata)
    return file.getvalue()


def test_the_library_reads_what_is_written_and_the_other_way_round():
    blob = blob_of(ARRAYS, {'card': 'é'})
    ours, metadata = read_blob(safetensors.numpy.save(
        {name: np.ascontiguousarray(array).reshape(array.shape)
         for name, array in ARRAYS.items()}, {'card': 'é'}))
    assert metadata == {'card': 'é'} and read_blob(blob)[1] == metadata
    for found in (safetensors.numpy.load(blob), ours, read_blob(blob)[0]):
        assert found.keys() == ARRAYS.keys()
        for name, array in ARRAYS.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)
    every_type = {name: np.ones(3, kind) for name, kind in TYPES.items()}
    assert {name: array.dtype for name, array in safetensors.numpy.load(
        blob_of(every_type)).items()} == {name: np.dtype(kind) for name, kind in TYPES.items()}


def header(**entries):
    """Return a blob with 8 bytes of arrays and a header of our own."""
    text = json.dumps({name: dict(zip(('dtype', 'shape', 'data_offsets'), entry))
                       for name, entry in entries.items()}).encode()
    return struct.pack('<Q', len(text)) + text + bytes(8)


@pytest.mark.parametrize('blob', [
    b'', b'1234567', struct.pack('<Q', 1 << 60) + b'{}', struct.pack('<Q', 2) + b'[]',
    struct.pack('<Q', 100_000) + b'[' * 100_000,
    header(), header(a=('F32', [1], [0, 4])), header(a=('F32', [2], [4, 12])),
    header(a=('F32', [2], [0, 8]), b=('F32', [2], [0, 8])), header(a=('F32', [-2], [0, -8])),
    header(a=('F33', [2], [0, 8])), header(a=('F32', [2.0], [0, 8])), header(a=('F32', 2, [0, 8])),
    header(a=('F32', [1 << 62, 4], [0, 8])), header(a=('F32', [2], [0, 8, 8])),
    header(a=('F32', [True, 2], [0, 8]))])
def test_a_damaged_blob_is_refused(blob):
    with pytest.raises(ValueError):
        read_blob(blob)
    with pytest.raises(safetensors.SafetensorError):
        safetensors.numpy.load(blob)

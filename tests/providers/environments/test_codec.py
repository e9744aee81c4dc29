"""Tests of the message codec: types that can and cannot be sent between processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mpsfm_core import DepthPrior, Features, PinholeCamera, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.environments.codec import EncodedMessage, decode_message
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration


def there_and_back(value, copy=True):
    packed = EncodedMessage(value)
    block = np.zeros(packed.size, dtype=np.uint8)
    packed.write(memoryview(block))
    return decode_message(packed.text, block, copy)


def test_decoded_values_equal_encoded_values():
    view = View(
        "a", np.arange(36, dtype=np.uint8).reshape(3, 4, 3), PinholeCamera(4, 3, 5, 5, 2, 1)
    )
    depth = DepthPrior.from_arrays(np.ones((2, 3)), metric=False)
    features = Features(np.empty((0, 2)), np.empty((0, 8), dtype=np.float32))
    value = {
        "plain": [None, True, 3, 0.1, "text", (1, 2), Path("x")],
        "types": (view, depth, features, DepthCalibration(shift=0.5)),
        "arrays": [np.array([[True, False]]), np.array(3.5), np.array([np.inf, np.nan])[::-1]],
    }
    back = there_and_back(value)
    assert back["plain"] == value["plain"]
    np.testing.assert_array_equal(back["types"][0].image, view.image)
    assert back["types"][0].camera == view.camera
    assert back["types"][1].variance is None and not back["types"][1].metric
    assert len(back["types"][2]) == 0 and back["types"][3].shift == 0.5
    for one, other in zip(back["arrays"], value["arrays"], strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_shared_arrays_are_read_only():
    array = there_and_back(np.zeros(3), copy=False)
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1


@pytest.mark.parametrize("value", [object(), np.array([object()]), {1: lambda: 0}])
def test_encode_of_other_objects_raises(value):
    with pytest.raises(DataError, match="cannot be sent to another process"):
        EncodedMessage(value)


@pytest.mark.parametrize(
    "text",
    [b"{", b'{"pickle": "x"}', b'{"type": "Popen", "fields": {}}', b'{"array": ["O", [1], 0]}'],
)
def test_nothing_but_the_protocol(text):
    with pytest.raises(DataError):
        decode_message(text, np.zeros(64, dtype=np.uint8), copy=True)

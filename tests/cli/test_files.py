"""What commands write."""

import json
import math

import pytest

from jaxsand.cli.files import as_json


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_null(value):
    text = as_json({"a": value, "b": [1.5, {"c": value}]})
    assert json.loads(text) == {"a": None, "b": [1.5, {"c": None}]}

"""How a file is to be read: bad values are named."""

import math

import pytest

from travjax.config import InputError
from travjax.rasters.reading_options import DemOptions


@pytest.mark.parametrize(
    ("values", "start"),
    [
        ({"cell_size": 0}, "cell_size = 0: must be metres, above 0"),
        ({"height_scale": math.inf}, "height_scale = inf: must be metres, above 0"),
        ({"nodata": math.inf}, "nodata = inf: must be a number: finite, or nan"),
        ({"nodata": "none"}, "nodata = 'none': must be a number"),
        ({"band": 0}, "band = 0: must be a number from 1 to 65535, or a name"),
        ({"band": True}, "band = True: must be"),
        ({"band": ""}, "band = '': must be"),
        ({"classes": ()}, "classes = (): must be codes from 0 to 255"),
        ({"classes": (2, 256)}, "classes = (2, 256): must be codes"),
        ({"up": "x"}, "up = 'x': must be one of y, z"),
        ({"gdal_drivers": "VRT"}, "gdal_drivers = 'VRT': must be names"),
    ],
)
def test_a_bad_value_is_named(values, start):
    with pytest.raises(InputError) as raised:
        DemOptions(**values)
    assert str(raised.value).startswith(start)


def test_nan_marks_unknown_ground_in_any_case():
    assert DemOptions(nodata=math.nan) == DemOptions()


def test_what_may_be_said():
    DemOptions(0.05, 0.01, -9999, "elevation", (2, 9), "y", ("BAG",))

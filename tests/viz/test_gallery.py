"""The gallery of shaped pieces of earth."""

import numpy as np
import pytest

from jaxsand.goals.tasks import make_task
from jaxsand.viz.gallery import gallery_figure


@pytest.mark.parametrize(("name", "along"), [("ring", "x"), ("pit-and-heap", "y"), ("level", None)])
def test_maps_and_section_show_before_goal_and_result(name, along):
    """The section of a ring crosses it twice, that of a pit and its heap crosses both; free cells have no height."""
    task = make_task(name, key=0)
    after = task.start + 0.001
    figure = gallery_figure([("done", task, after)])
    before, goal, result, section, bar = figure.axes
    assert [panel.get_title(loc="left") for panel in (before, goal, result)] == ["before", "goal", "result"]
    np.testing.assert_allclose(np.asarray(result.images[0].get_array(), float), 1e3 * after, atol=1e-5)
    np.testing.assert_array_equal(np.ma.getmaskarray(goal.images[0].get_array()), task.goal.free)
    assert len({panel.images[0].get_clim() for panel in (before, goal, result)}) == 1
    assert bar.get_ylim() == result.images[0].get_clim()
    drawn = {line.get_label(): np.asarray(line.get_ydata(), float) for line in section.get_lines()}
    if along:
        assert section.get_title(loc="left") == f"mm along {along} (m)"
        asked = np.nan_to_num(drawn["goal"] - drawn["before"])
        assert np.count_nonzero(np.diff(abs(asked) > 0.5 * abs(asked).max())) == 4
    np.testing.assert_allclose(drawn["result"] - drawn["before"], 1, atol=1e-5)

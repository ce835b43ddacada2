"""Free joint: a position in the world and an attitude; three slides, then a ball."""

from rbjax.joints.ball import ball_links
from rbjax.joints.joint import Joint, LinkForm
from rbjax.joints.slide import SLIDE

_SLIDES = (
    LinkForm(SLIDE, one, one, k, None, one, False) for k in range(3) for one in [range(k, k + 1)]
)


class Free(Joint):
    """q = [position in the world, m; unit quaternion], v = [its rate in world axes; angular
    velocity in body axes]."""

    name = "free"
    links = (*_SLIDES, *ball_links(3, 3))
    nq, quaternion, aligned, on_world = 7, True, False, True

"""Which frames are kept for evaluation. Not a setting: the files of a run and their readers promise this rule."""

HELD_OUT_PERIOD = 8
HELD_OUT_OFFSET = 4


def is_held_out(frame_index: int) -> bool:
    """Whether a frame is kept for evaluation: tracked, but never a keyframe and never mapped.

    Args:
        frame_index: in the log of the robot, from 0.
    """
    return frame_index % HELD_OUT_PERIOD == HELD_OUT_OFFSET

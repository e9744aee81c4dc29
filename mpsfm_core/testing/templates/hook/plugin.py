from pathlib import PurePosixPath

from mpsfm_core import hookimpl


@hookimpl
def mpsfm_filter_pairs(pairs):
    """Keep pairs whose images are in one folder: put your selection here.

    A pair has two image names with folder and extension, such as ("left/a.jpg", "left/b.jpg").
    """
    return [(a, b) for a, b in pairs if PurePosixPath(a).parent == PurePosixPath(b).parent]


@hookimpl
def mpsfm_stage_progress(stage, done, total):
    """Receive the progress of a stage: show it, or send it to another program."""

import numpy as np

from mpsfm_core import Options, PairMatches, SparseMatches


class ${Class}Options(Options):
    min_similarity: float = 0.7


class $Class:
    """Match mutual nearest neighbors by cosine similarity: put your matcher here."""

    def __init__(self, options, context):
        self._options = options

    def match(self, view_a, view_b, features_a=None, features_b=None):
        indices, scores = np.empty((0, 2), np.int64), np.empty(0, np.float32)
        if len(features_a) and len(features_b):
            similarity = _unit(features_a.descriptors) @ _unit(features_b.descriptors).T
            best, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
            rows = np.flatnonzero(back[best] == np.arange(len(best)))
            scores = np.clip(similarity[rows, best[rows]], 0, 1)
            keep = scores >= self._options.min_similarity
            indices, scores = np.stack([rows, best[rows]], axis=1)[keep], scores[keep]
        return PairMatches(sparse=SparseMatches(indices, scores))


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)

"""Finished reconstructions in the formats of other programs: one file a format.

A format is found by its name in :mod:`mpsfm_core.results.exports.formats`.
"""

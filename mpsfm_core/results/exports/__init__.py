"""Exports of reconstructions to the formats of other programs; one module for each format.

:mod:`mpsfm_core.results.exports.formats` lists the formats.
"""

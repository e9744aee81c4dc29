"""Providers that live in other Python environments, used as if they were here.

A worker process of the other environment (:mod:`mpsfm_core.providers.environments.worker`) makes
the provider and answers; :mod:`remote` is this side of it. Arrays pass through memory that both
processes map. """

"""Providers in other Python environments, used through a worker process.

A worker in the other environment (:mod:`mpsfm_core.providers.environments.worker`) constructs the
provider and answers requests. :mod:`remote_provider` is the client in this process. Arrays pass
through memory that both processes map.
"""

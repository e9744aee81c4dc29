"""Providers in other Python environments, which run in worker processes.

A worker process in the other Python environment (:mod:`mpsfm_core.providers.environments.worker`)
constructs the provider and runs its methods. The module :mod:`remote_provider` is the client, which
forwards calls of this process to the worker process. Arrays are transferred through shared memory.
"""

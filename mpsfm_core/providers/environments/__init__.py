"""Providers in other Python environments, called through a worker process.

A worker process in the other environment (:mod:`mpsfm_core.providers.environments.worker`)
constructs the provider and runs its methods. The client in this process is :mod:`remote_provider`.
Arrays are transferred through shared memory.
"""

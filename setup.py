"""What pyproject.toml cannot say: the top-level configs/ is installed inside of the package."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["mpsfm_core", "mpsfm_core.*"]), "mpsfm_core.configs"],
    package_dir={"mpsfm_core.configs": "configs"},
    package_data={"mpsfm_core": ["py.typed"], "mpsfm_core.configs": ["*.yaml"]},
)

"""What pyproject.toml cannot say: the top-level configs/ is installed inside of the package, and
the templates of new plugins are data although they look like code."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["mpsfm_core", "mpsfm_core.*"]), "mpsfm_core.configs"],
    package_dir={"mpsfm_core.configs": "configs"},
    py_modules=["mpsfm_pytest"],
    package_data={
        "mpsfm_core": ["py.typed"],
        "mpsfm_core.configs": ["*.yaml"],
        "mpsfm_core.testing": ["templates/*/*", "templates/*/tests/*"],
    },
)

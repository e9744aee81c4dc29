"""Install the data that pyproject.toml cannot describe.

The top-level configs/ and the photos of the sample scene are installed inside the package. The
templates of new plugins are data although they look like code.
"""

from setuptools import find_packages, setup

DATA = {
    "mpsfm_core.configs": "configs",
    "mpsfm_core.sample_scene.images": "examples/sample_scene/images",
    "mpsfm_core.sample_scene.gt": "examples/sample_scene/gt",
}

setup(
    packages=[*find_packages(include=["mpsfm_core", "mpsfm_core.*"]), *DATA],
    package_dir=DATA,
    py_modules=["mpsfm_pytest"],
    package_data={
        "mpsfm_core": ["py.typed"],
        "mpsfm_core.configs": ["*.yaml"],
        "mpsfm_core.sample_scene.images": ["*.jpg"],
        "mpsfm_core.sample_scene.gt": ["*.txt"],
        "mpsfm_core.report": ["assets/page.*", "assets/three.min.js", "assets/three.LICENSE"],
        "mpsfm_core.testing": ["templates/*/*", "templates/*/tests/*"],
    },
)

from mpsfm_core import ProviderSpec, hookimpl


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="wrapper",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            capabilities=frozenset({"wraps-depth", "wraps-normals"}),
            code_license="Apache-2.0",
        )
    ]

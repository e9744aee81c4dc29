from mpsfm_core import ProviderSpec, hookimpl


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="retrieval",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            code_license="Apache-2.0",
        )
    ]

from mpsfm_core import ProviderSpec, hookimpl


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="mask",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            contract="$module.contract:contract",
            code_license="Apache-2.0",
        )
    ]

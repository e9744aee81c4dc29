from mpsfm_core import ProviderSpec, hookimpl


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="depth",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            capabilities=frozenset({"metric"}),
            contract="$module.contract:contract",
            code_license="Apache-2.0",
        )
    ]

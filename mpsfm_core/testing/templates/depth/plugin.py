from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import weights_from_option


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="depth",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            capabilities=frozenset({"metric"}),
            weights=weights_from_option("weights"),
            contract="$module.contract:contract",
            code_license="Apache-2.0",
        )
    ]

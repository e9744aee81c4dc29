from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import file_named_by


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="multiview",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            capabilities=frozenset({"metric"}),
            weights=file_named_by("weights"),
            contract="$module.contract:contract",
            code_license="Apache-2.0",
        )
    ]

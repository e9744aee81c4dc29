from mpsfm_core import ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    return [
        ProviderSpec(
            kind="depth",
            name="ridge-depth",
            factory="ridge_depth.model:RidgeDepth",
            options="ridge_depth.model:RidgeDepthOptions",
            capabilities=frozenset({"metric"}),
            contract="ridge_depth.contract:contract",
            code_license="Apache-2.0",
            weights_license="Apache-2.0",
            weights=(WeightsFile("package:ridge_depth/room.npz", license="Apache-2.0"),),
            calibration=DepthCalibration(relative_std=0.11),  # measured by train.py
        )
    ]

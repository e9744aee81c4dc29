import numpy as np

from mpsfm_core.testing import Setup
from mpsfm_core.testing.painting import decoder


def contract(folder):
    """Weights with which the network reads the depth that is painted in the contract's views."""
    weights, bias = decoder()
    np.savez(folder / "tiny.npz", weights=255 * weights[0], bias=bias[0])
    return Setup(options={"weights": str(folder / "tiny.npz")}, knows="painted")

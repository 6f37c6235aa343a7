"""One capture of a human head in, one registration (a mesh in the model's topology) out."""

import os

# Torch's threads spin after each operation by default, and so take the cores from the renderer's threads (and from
# every other process): steps were measured up to six times slower. Must be set before torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

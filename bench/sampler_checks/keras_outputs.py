"""Write what Keras computes with a released decoder; runs in an environment that has Keras, without this project.

python bench/sampler_checks/keras_outputs.py DECODER.h5 LATENT_AND_CONDITIONS.npz OUTPUT.npz
"""

import sys

import keras
import numpy as np

if __name__ == "__main__":
    model = keras.models.load_model(sys.argv[1], compile=False)
    given = np.load(sys.argv[2])
    outputs = np.asarray(model([given["latent"], given["conditions"]]))
    np.savez(sys.argv[3], outputs=outputs, version=np.array(keras.__version__))

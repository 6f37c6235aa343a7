"""One capture of a human head in, one registration (a mesh in the model's topology) out."""

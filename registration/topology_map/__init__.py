"""Maps between topologies: which point of one head's surface each vertex of another head lies on."""

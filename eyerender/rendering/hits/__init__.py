"""Ray intersections: exact surfaces of the eye, meshes of them, menisci, and the region."""

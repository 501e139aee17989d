"""What a Gaussian is: float32 arrays, integer codes, rows of a segment, a place in the UV map."""

"""The UV atlas as pictures and video, for people and other programs (paper, preliminaries)."""

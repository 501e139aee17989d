"""What moves in the pictures: optical flow and masks, the background, keyframes."""

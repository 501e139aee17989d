"""When each frame was taken: timecodes, AVL index, clock model, frame groups."""

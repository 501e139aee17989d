"""Pictures of a capture: decoded on demand, undistorted and balanced in colour."""

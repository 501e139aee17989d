"""What a fit starts from: the scene's bounds, the shell around it, points, the hull of what moves."""

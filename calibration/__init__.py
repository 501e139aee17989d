"""Where the cameras stand and how they see colour."""

"""What stages leave: recipes, digests, the store, and the jobs that do the work."""

"""Being written by the helper that has the list of issue 5: please leave it."""

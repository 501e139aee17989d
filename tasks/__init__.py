"""The artefact store and one thin Prefect task per stage."""

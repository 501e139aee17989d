"""The artefact store, the stages, their report, and stages as Prefect tasks."""

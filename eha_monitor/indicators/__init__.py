"""Health in the units a maintenance engineer acts on; laws and limits: docs/health.md."""

"""The workbench: a page with Rerun's viewer and a panel that answers what is clicked."""

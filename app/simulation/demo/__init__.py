"""The demo: a synthetic study on one machine, loaded through the REST interface, that shows the whole loop."""

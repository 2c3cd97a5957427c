"""The face: what ``import starcat`` gives, each name a thin layer over the rooms."""

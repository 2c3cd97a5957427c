"""What a browser shows: pages made on the server, and the small scripts that they use."""

from __future__ import annotations

from fastapi import APIRouter

from starcat_service.pages import (
    catalogs,
    console,
    databases,
    documentation,
    downloads,
    home,
    identify,
    jobs,
    new,
    plan,
    releases,
    rendering,
    sky,
    tokens,
)

ROUTERS: tuple[APIRouter, ...] = (
    rendering.static_router,
    home.router,
    new.router,
    jobs.router,
    databases.router,
    console.router,
    identify.router,
    plan.router,
    releases.router,
    documentation.router,
    sky.router,
    catalogs.router,
    tokens.router,
    downloads.router,
)
"""Routers of the page, in the order in which they are asked."""

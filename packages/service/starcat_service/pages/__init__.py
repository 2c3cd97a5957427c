"""The pages of the service: made on the server, with small scripts."""

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
"""Routers of the pages, in the order in which they are tried."""

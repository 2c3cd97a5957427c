"""What a browser shows: pages made on the server, and the small scripts that they use."""

from __future__ import annotations

from fastapi import APIRouter

from starcat.service.pages import (
    console,
    databases,
    home,
    identify,
    interface,
    jobs,
    new,
    reference,
    releases,
    sign_in,
    static_files,
)

ROUTERS: tuple[APIRouter, ...] = (
    static_files.router,
    sign_in.router,
    home.router,
    new.router,
    reference.router,
    jobs.router,
    databases.router,
    console.router,
    identify.router,
    interface.router,
    releases.router,
)
"""Routers of the page, in the order in which they are asked."""

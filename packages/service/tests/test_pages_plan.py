"""The page *Plan*: attitudes that are pasted or uploaded, and tables that are refused."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

from services import DATABASE

import starcat

TABLE = (
    "time,ra_deg,dec_deg,roll_deg\n2027-03-01T06:30:00,83.8,-5.4,0\n2027-03-01T06:31:00,85,-5,0\n"
)
AEM = Path(__file__).parents[3] / "tests" / "data" / "five_attitudes.aem"


def test_attitudes_are_planned_as_in_python(client, small_artifact, tmp_path):
    angles = {"keep_out.Sun": "179", "noise_px": "0.5"}
    answer = client.post("/plan", data={"database": DATABASE, "attitudes": TABLE, **angles})
    assert answer.status_code == 200, answer.text
    [packed] = re.findall(r'href="data:application/json;base64,([^"]+)"', answer.text)
    found = json.loads(base64.b64decode(packed))
    (tmp_path / "table.csv").write_text(TABLE)
    expected = starcat.plan(
        small_artifact, tmp_path / "table.csv", keep_out_deg={"Sun": 179.0}, noise_px=0.5
    )
    assert found["summary"] == expected.summary
    assert found["attitudes"] == [expected.attitude(row) for row in range(2)]
    assert found["first_stars"] == expected.stars_of(0)
    assert "0 of 2 attitudes usable" in answer.text
    assert "2027-03-01T06:31:00Z" in answer.text
    [plot] = re.findall(r'<img src="data:image/svg[+]xml;base64,([^"]+)"', answer.text)
    assert b"<svg" in base64.b64decode(plot)
    uploaded = client.post(
        "/plan", data={"database": DATABASE}, files={"file": ("../a.aem", AEM.read_bytes())}
    )
    assert "of 5 attitudes usable" in uploaded.text


def test_a_table_that_is_too_long_is_refused(client):
    answer = client.post("/plan", data={"database": DATABASE, "attitudes": "x\n" * 20_000})
    assert answer.status_code == 413
    assert "more than 10,000 lines" in answer.text

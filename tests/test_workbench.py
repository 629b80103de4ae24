"""The workbench's page without a browser: its questions and their answers, and who is let in."""

from __future__ import annotations

import json
import re
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import pytest

import bevviz
from bevviz.cli import main
from bevviz.pipeline.notes import Note, Notes
from bevviz.workbench.access import persistent_token
from bevviz.workbench.buffers import AHEAD
from tests.support.small_disk import small_disk
from tests.support.waiting import PATIENCE
from tests.support.workbench_pages import FRAMES, Talk, channel, demo_bag, served

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

Hinted = list[tuple[int, str, dict[str, Any]]]  # time and pick of each missed object, and its hints


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("workbench"))


@pytest.fixture(scope="module")
def address(bag: Path) -> Iterator[str]:
    with served(bag) as address:
        with Talk(address):  # Once the drive has been run, pages get all findings at once.
            pass
        yield address


# --- questions and answers ----------------------------------------------------------------------


@pytest.fixture
def talk(address: str) -> Iterator[Talk]:
    with Talk(address) as talk:
        yield talk


@pytest.fixture(scope="module")
def hinted(address: str) -> Hinted:
    """Return what the page is told about each missed object."""
    with Talk(address) as talk:
        sights = [entry["sights"][0] for entry in talk.of("missed")]
        return [
            (stamp, pick, talk.asked("hints", type="ask", time=stamp, set=[], pick=pick))
            for stamp, pick in map(stamp_and_pick, sights)
        ]


def stamp_and_pick(sight: dict[str, Any]) -> tuple[int, str]:
    """Return the stamp of a frame of a finding, and the text that asks about its object."""
    return int(sight["stamp"]), sight["pick"]


def helped(hinted: Hinted) -> tuple[int, str, dict[str, Any]]:
    """Time and pick of a missed object, and a hint that helps it: the one that helps the frame most."""
    hints = [(stamp, pick, hint) for stamp, pick, told in hinted for hint in told["hints"]]
    return max(hints, key=lambda one: len(one[2]["fixed"]) - len(one[2]["false"]) - len(one[2]["right"]))


def test_one_missed_object_is_one_entry(talk: Talk) -> None:
    """However many frames it lasts; no two entries have the same object of a frame."""
    missed = talk.of("missed")
    assert any(len(entry["sights"]) > 2 for entry in missed)
    sights = [(sight["frame"], sight["pick"]) for entry in missed for sight in entry["sights"]]
    assert len(sights) == len(set(sights))
    for entry in missed:
        numbers = [sight["frame"] for sight in entry["sights"]]
        assert numbers == sorted(set(numbers))
        assert all(sight["text"] for sight in entry["sights"]), "its reason"


@pytest.mark.long
def test_rows_of_the_list_agree_with_their_answers(talk: Talk) -> None:
    """One kind, subject, distance and reason, whether it is read in the list or asked for."""
    for entry in talk.of("missed", "false"):
        for sight in entry["sights"]:
            stamp, pick = stamp_and_pick(sight)
            answer = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)
            address = f"{answer['kind']}/{answer['camera']}/{answer['row']}"
            assert (address, answer["label"].lower(), answer["reason"]) == (
                pick,
                entry["name"],
                sight["text"],
            )
            assert answer["distance"] == sight["distance"] and not sight["tried"]
            assert answer["reported"] == answer["false"] == (entry["what"] == "false")


def test_empty_ground_and_several_things_are_told(talk: Talk) -> None:
    stamp = next(iter(talk.of("missed")))["sights"][0]["stamp"]
    ground = talk.asked("answer", type="ask", time=int(stamp), set=[], pick="point//6,0,-1.6")
    assert re.search(r"only ground .*: \d+ points, all ground", ground["verdict"])
    answers = [
        talk.asked("answer", type="ask", time=int(stamp), set=[], pick=f"pixel/zed/{u},140")
        for u in range(100, 640, 60)
    ]
    several = [answer for answer in answers if answer["beside"]]
    assert several
    other = several[0]["beside"][0]
    again = talk.asked("answer", type="ask", time=int(stamp), set=[], pick=other["pick"])
    assert again["name"] == other["name"]


@pytest.mark.long
def test_the_subject_is_followed_over_frames(talk: Talk) -> None:
    """An object is asked by its row in one frame, and found by its id in each other one."""
    stamp, pick = stamp_and_pick(talk.of("missed")[0]["sights"][0])
    first = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)
    identity = json.loads(first["pick"])
    for frame in range(FRAMES):
        time_ = stamp + (frame - first["frame"]) * 100_000_000
        values = ["clustering.eps=0.9"] if frame % 2 else []
        message = talk.asked("answer", type="ask", time=time_, set=values, pick=first["pick"])
        assert (message["frame"], message["set"]) == (frame, values)
        assert json.loads(message["pick"])["id"] == identity["id"]
        assert message["label"].lower() == identity["label"]
    gone = json.dumps({**identity, "id": "nobody"})
    absent = talk.asked("absent", type="ask", time=stamp, set=[], pick=gone)
    assert f"is not in frame {first['frame']}: the ground truth has no" in absent["text"]


def test_rows_are_valid_in_their_own_frame_only(talk: Talk) -> None:
    """A row of the list that is asked with tried values is the object of the list."""
    for entry in talk.of("false"):
        frame, (stamp, pick) = entry["sights"][0]["frame"], stamp_and_pick(entry["sights"][0])
        origin = {"time": stamp, "set": []}
        opened = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)
        wanted = {"type": "ask", "time": stamp, "pick": pick, "origin": origin}
        tried = talk.asked("answer|absent", **wanted, set=["detector.conf_threshold=0.5"])
        assert tried["frame"] == frame
        if tried["type"] == "absent":
            assert opened["label"] in tried["text"] and "with these values" in tried["text"]
            continue
        assert tried["kind"] == "cluster" or tried["label"] == opened["label"]
        assert tried["position"][:2] == pytest.approx(opened["position"][:2], abs=1.5)


def test_a_hint_has_the_promised_effect(talk: Talk, hinted: Hinted) -> None:
    """What it was said to do to the frame is what the panel says when it is pressed, name by name."""
    stamp, pick, hint = helped(hinted)
    tried = talk.asked("tried", type="try", time=stamp, set=hint["settings"], pick=pick)
    assert tried["effects"] == {key: hint[key] for key in tried["effects"]}
    assert hint["fixed"]
    assert tried["f1"]["after"] > tried["f1"]["before"]


def test_a_remark_tells_the_reason_of_its_row(talk: Talk) -> None:
    """The rows of an overview have none before."""
    sight = talk.of("missed")[0]["sights"][0]
    frame, pick = sight["frame"], sight["pick"]
    talk.say(type="remarks", rows=[{"frame": frame, "pick": pick}])
    remark = talk.until("remark", lambda one: (one["frame"], one["pick"]) == (frame, pick))
    answer = talk.asked("answer", type="ask", time=int(sight["stamp"]), set=[], pick=pick)
    assert remark["text"] == answer["reason"] == sight["text"]


def test_without_a_hint_a_sentence_names_the_tried_changes(hinted: Hinted) -> None:
    sentences = []
    for _, _, message in hinted:
        assert message["hints"] or re.match(r"(No tried|The one tried|Nothing was tried)", message["remark"])
        sentences += [] if message["hints"] else [message["remark"]]
    assert any(re.fullmatch(r"No tried change helps: with \w+\.\w+=.*\.", text) for text in sentences)


@pytest.mark.long
def test_the_drive_is_run_with_other_values(talk: Talk, address: str, hinted: Hinted) -> None:
    """Every frame, with what it makes better and worse; another page is told the same; it can be ended."""
    stamp, pick, hint = helped(hinted)
    with Talk(address) as other:
        talk.say(type="drive", set=hint["settings"])
        trials = [
            one.until("progress", lambda m: m["trials"] and m["trials"][-1]["state"] == "over")["trials"][-1]
            for one in (talk, other)
        ]
        assert trials[0] == trials[1]
    trial = trials[0]
    assert trial["done"] == trial["total"] == FRAMES
    assert trial["f1"]["before"] != trial["f1"]["after"]
    fixed = [stamp_and_pick(sight) for entry in talk.of("fixed") for sight in entry["sights"]]
    assert (stamp, pick) in fixed
    assert len(fixed) == trial["counts"]["fixed"]
    talk.say(type="drive", set=["clustering.eps=0.7"])
    talk.say(type="cancel", what="drive")
    ended = talk.until("progress", lambda m: m["trials"][-1]["settings"] == ["clustering.eps=0.7"])["trials"][
        -1
    ]
    while ended["state"] in ("waiting", "running"):
        ended = talk.until("progress")["trials"][-1]
    assert ended["state"] in ("cancelled", "over")
    assert "nothing is changed" in talk.asked("never", type="drive", set=[])["text"]
    assert "clustering.epps" in talk.asked("never", type="drive", set=["clustering.epps=1"])["text"]


@pytest.mark.long
def test_notes_are_kept_beside_the_bag(talk: Talk, bag: Path) -> None:
    stamp, pick = stamp_and_pick(talk.of("missed")[0]["sights"][0])
    pick = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)["pick"]
    talk.say(type="note", time=stamp, pick=pick, text=" look here ")
    (note,) = talk.until("notes", lambda message: message["notes"])["notes"]
    assert (note["stamp"], note["pick"], note["text"]) == (str(stamp), pick, "look here")
    assert [str(one) for one in Notes([bag])] == [f"{note['about']}: look here"]
    assert "characters" in talk.asked("noted", type="note", time=stamp, pick="", text="  ")["text"]
    talk.say(type="unnote", stamp=str(stamp), text="look here")
    talk.until("notes", lambda message: not message["notes"])
    assert not Notes([bag]).path.exists()


def test_a_note_about_a_place_names_it_as_the_answer_does(talk: Talk) -> None:
    stamp = int(talk.of("missed")[0]["sights"][0]["stamp"])
    answer = talk.asked("answer", type="ask", time=stamp, set=[], pick="pixel/zed/20,20")
    said = talk.asked("noted", type="note", time=stamp, pick=answer["pick"], text="empty road")
    assert said["text"].startswith("Noted about what is at pixel 20, 20 in frame ")
    talk.say(type="unnote", stamp=str(stamp), text="empty road")
    talk.until("notes", lambda message: not message["notes"])


@pytest.mark.long
def test_a_report_has_what_was_asked_tried_and_noted(
    talk: Talk, address: str, bag: Path, hinted: Hinted
) -> None:
    """The verdict of the drive as it was run comes first; beside the bag; for who has the token."""
    stamp, pick, hint = helped(hinted)
    before = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)
    after = talk.asked("answer", type="ask", time=stamp, set=hint["settings"], pick=pick)
    assert after["reported"] and not before["reported"]
    talk.say(type="note", time=stamp, pick=pick, text="a note of mine")
    talk.until("noted")
    said = {"before": 0.2, "after": 0.1, "text": "it is plainly there", "set": hint["settings"]}
    talk.say(type="report", time=stamp, pick=before["pick"], **said)
    made = talk.until("progress", lambda m: m["reports"] and m["reports"][-1]["state"] != "running")[
        "reports"
    ][-1]
    assert made["state"] == "over", made["error"]
    assert made["done"] == made["total"] > 0
    assert made["settings"] == hint["settings"]
    assert Path(made["folder"]) == bag.parent
    assert {file["name"] for file in made["files"]} <= {path.name for path in bag.parent.iterdir()}
    site, token = address.split("/?")
    (page,) = [file["name"] for file in made["files"] if file["name"].endswith(".html")]
    link = f"{site}/report/{made['number']}/{page}"
    assert answered(link) == 403
    assert answered(f"{site}/report/{made['number']}/..%2f..%2fetc%2fpasswd?{token}") == 404
    with urllib.request.urlopen(f"{link}?{token}", timeout=PATIENCE) as response:
        text = response.read().decode()
    assert "it is plainly there" in text
    assert "a note of mine" in text
    assert f"<code>{', '.join(hint['settings'])}</code>" in text
    told = " ".join(re.sub(r"<[^>]*>", " ", unescape(text)).split())
    places = [
        told.index(part) for part in ("Missed: the", before["verdict"], "What was tried", after["verdict"])
    ]
    assert places == sorted(places)
    assert f"{', '.join(hint['settings'])} {after['verdict']}" in told
    assert "--set-b" in told
    assert hint["settings"][0].partition("=")[0] not in told[told.index("How it was made") :]
    talk.say(type="unnote", stamp=str(stamp), text="a note of mine")
    assert "up to 600" in talk.asked("never", type="report", time=stamp, before=1e9, after=0, text="")["text"]


@pytest.mark.long
def test_a_report_is_about_the_object_of_its_own_tab(talk: Talk, address: str, hinted: Hinted) -> None:
    """Another tab asks about another object of the same frame afterwards."""
    stamp, pick, _ = helped(hinted)
    mine = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)
    other_pick = next(p for s, p, _ in hinted if s == stamp and p != pick)
    with Talk(address) as other:
        theirs = other.asked("hints", type="ask", time=stamp, set=[], pick=other_pick)
        assert theirs["row_pick"] == other_pick
        talk.say(type="report", time=stamp, set=[], pick=mine["pick"], before=0, after=0, text="")
        made = talk.until("progress", lambda m: m["reports"] and m["reports"][-1]["state"] != "running")
    report = made["reports"][-1]
    assert report["state"] == "over", report["error"]
    (page,) = [file["name"] for file in report["files"] if file["name"].endswith(".html")]
    text = (Path(report["folder"]) / page).read_text()
    assert f"Missed: {mine['name']}" in " ".join(re.sub(r"<[^>]*>", " ", unescape(text)).split())
    far = max(talk.of("missed"), key=lambda entry: int(entry["sights"][-1]["stamp"]))["sights"][-1]
    absent = {"kind": "truth", "label": "bus", "frame": 0, "id": "bus of another drive"}
    said = talk.asked(
        "never",
        type="report",
        time=int(far["stamp"]),
        set=[],
        pick=json.dumps(absent),
        before=0,
        after=0,
        text="",
    )
    assert "of the drive as opened" in said["text"]


@pytest.mark.long
def test_a_report_has_the_notes_of_its_window(bag: Path, tmp_path: Path) -> None:
    copy = tmp_path / "drive.mcap"
    copy.hardlink_to(bag)
    with bevviz.open(copy) as drive:
        frames = [drive.raw(number) for number in (1, 5)]
    for frame, text in zip(frames, ("in the window", "outside of it"), strict=True):
        Notes([copy]).add(Note(frame.stamp, frame.received, text))
    output = tmp_path / "bug.rrd"
    options = ["--at", "0.1", "--before", "0", "--after", "0.1", "-o", str(output)]
    assert main(["report", str(copy), *options]) == 0
    page = output.with_suffix(".html").read_text()
    assert "in the window" in page
    assert "outside of it" not in page


def test_the_frame_that_is_looked_at_comes_first(address: str) -> None:
    """A page that acknowledges no piece gets a few pieces, and the one that it asks for, after its number."""

    def piece(page: ClientConnection) -> tuple[str, bytes]:
        number, content = "", page.recv(timeout=PATIENCE)
        if isinstance(content, str):
            number, content = content, page.recv(timeout=PATIENCE)
        assert isinstance(content, bytes)
        return number, content

    with Talk(address) as talk:
        last = max(int(s["stamp"]) for entry in talk.of("missed", "false") for s in entry["sights"])
    with channel(address, "/recording") as page:
        whole = list[tuple[str, bytes]]()
        while len(whole) <= FRAMES:
            whole.append(piece(page))
            page.send("got it")
    numbers = dict.fromkeys(number for number, _ in whole if number)  # The first frame is recorded again.
    assert list(numbers) == [str(number) for number in range(FRAMES)]
    with channel(address, "/recording") as page:
        assert [piece(page) for _ in range(AHEAD)] == whole[:AHEAD]
    with channel(address, "/recording") as page:
        page.send(str(last))
        asked = [piece(page)]
        while asked[-1] != whole[FRAMES]:
            asked.append(piece(page))
    assert len(set(asked)) == len(asked) <= AHEAD + 1


# --- who is let in ------------------------------------------------------------------------------


def answered(url: str, **headers: str) -> int:
    """Status of the answer."""
    request = urllib.request.Request(url, headers={k.replace("_", "-"): v for k, v in headers.items()})
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as response:
            return int(response.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_only_clients_with_the_token_are_admitted(address: str) -> None:
    parts = urlsplit(address)
    site = f"http://{parts.netloc}"
    token = parse_qs(parts.query)["token"][0]
    assert answered(address) == 200
    assert answered(f"{site}/") == 403
    assert answered(f"{site}/?token=wrong") == 403
    assert answered(f"{site}/page/panel.js?token={token}") == 200
    assert answered(f"{site}/page/panel.js") == 403
    assert answered(f"{site}/page/..%2fserver.py?token={token}") == 404
    assert answered(f"{site}/config.yaml?token={token}&set=clustering.eps=0.7") == 200
    assert answered(f"{site}/config.yaml?token={token}&set=clustering.eps=-1") == 400


def test_other_hosts_and_origins_are_refused(address: str) -> None:
    """A name that somebody else lets lead here, and a page of another site that knows the token."""
    parts = urlsplit(address)
    assert answered(address, Host="evil.example") == 403
    assert answered(address, Host=f"evil.example:{parts.port}") == 403
    assert answered(address, Origin="http://evil.example") == 403
    assert answered(address, Origin=f"http://{parts.netloc}") == 200


def test_a_server_that_stops_cancels_waiting_requests_quietly(capfd: pytest.CaptureFixture[str]) -> None:
    """A page waits for the drive to be opened when the user ends the server."""
    import asyncio
    import threading

    from starlette.types import Receive, Scope, Send
    from websockets.exceptions import ConnectionClosed

    from bevviz.workbench.access import Guard
    from bevviz.workbench.server import Server, bound_socket

    async def waits(scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        await asyncio.sleep(PATIENCE)

    with bound_socket(0) as listening:
        place, ready = f"127.0.0.1:{listening.getsockname()[1]}", threading.Event()
        server = Server(Guard(waits, "token", listening.getsockname()[1]), ready.set)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        assert ready.wait(PATIENCE)
        with channel(f"http://{place}/?token=token", "/") as page:
            server.end()
            with pytest.raises(ConnectionClosed):
                page.recv(timeout=PATIENCE)
        thread.join(PATIENCE)
    assert not thread.is_alive()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("path", ["/talk", "/recording"])
def test_channels_are_guarded(address: str, path: str) -> None:
    from websockets.exceptions import InvalidStatus

    with channel(address, path) as page:
        assert page.recv(timeout=PATIENCE)
    for origin, token in (("http://evil.example", True), (None, True), ("", False)):
        with pytest.raises(InvalidStatus) as refused:
            channel(address, path, origin, token)
        assert refused.value.response.status_code == 403


def test_invalid_messages_are_answered(address: str) -> None:
    with channel(address, "/talk") as page:

        def answer(message: str) -> str:
            page.send(message)
            while True:
                found = json.loads(page.recv(timeout=PATIENCE))
                if found["type"] == "error":
                    return str(found["text"])

        assert answer("{") == "that message cannot be understood"
        assert answer("[]") == "that message cannot be understood"
        assert answer('{"id": 1, "type": "ask", "time": "x"}') == "that message cannot be understood"
        assert "of number 999" in answer('{"id": 2, "type": "ask", "time": 0, "pick": "truth//999"}')
        assert "nothing that can be asked" in answer('{"id": 3, "type": "ask", "time": 0, "pick": "car"}')
        wrong = '{"id": 5, "type": "try", "time": 0, "set": ["clustering.epps=1"]}'
        assert "clustering.epps" in answer(wrong)


def test_two_drives_at_once(bag: Path, address: str) -> None:
    """Each has a port and a token of its own."""
    with served(bag) as other:
        assert answered(other) == 200
        assert urlsplit(other).port != urlsplit(address).port
        assert urlsplit(other).query != urlsplit(address).query
        assert answered(f"{other.split('?')[0]}?{urlsplit(address).query}") == 403


@pytest.mark.long
def test_a_damaged_bag_is_opened_as_far_as_it_goes(bag: Path, tmp_path: Path) -> None:
    """What could be read is run and asked about; what was lost is said."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    with served(cut) as address, Talk(address) as talk:
        assert 0 < talk.over["done"] < FRAMES
        assert talk.over["warnings"]
        assert talk.entries


def test_a_token_outlives_a_server_that_was_killed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with persistent_token(1, "drive") as first:
        (kept,) = tmp_path.glob("bevviz/*")
        assert kept.stat().st_mode & 0o077 == 0
        left = kept.read_bytes()
    assert not kept.exists()
    kept.write_bytes(left)
    with persistent_token(1, "drive") as readable_by_others:
        assert readable_by_others != first
    kept.touch(mode=0o600)
    kept.chmod(0o600)
    kept.write_bytes(left)
    with persistent_token(1, "another drive") as other:
        assert other != first
    kept.touch(mode=0o600)
    kept.write_bytes(left)
    with persistent_token(1, "drive") as again:
        assert again == first


def test_a_file_that_is_no_bag_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no bag")
    assert main(["open", str(broken), "--no-browser"]) == 2
    assert "broken.mcap" in capsys.readouterr().err


def test_a_slow_try_keeps_no_question_waiting(talk: Talk) -> None:
    """It can be cancelled; its own answer comes never, that of the next try at once."""
    slow, entry = ["bev.resolution=0.02"], talk.of("missed")[0]
    stamp, pick = stamp_and_pick(entry["sights"][0])
    talk.say(type="try", time=stamp, set=slow, pick=pick)
    talk.say(type="ask", time=stamp, set=[], pick=pick)
    first = talk.until("tried|answer")
    assert first["type"] == "answer" and first["set"] == []
    talk.say(type="try", time=stamp, set=["bev.resolution=0.025"], pick=pick)
    talk.say(type="cancel", what="try")
    talk.say(type="try", time=stamp, set=["clustering.eps=0.9"], pick=pick)
    tried = talk.until("tried")
    while tried["type"] == "error":
        assert tried["text"] == "the try was cancelled"
        tried = talk.until("tried")
    assert tried["set"] == ["clustering.eps=0.9"]


def test_a_question_about_a_cancelled_try_is_answered(talk: Talk) -> None:
    values, entry = ["bev.resolution=0.03"], talk.of("missed")[0]
    stamp, pick = stamp_and_pick(entry["sights"][0])
    talk.say(type="try", time=stamp, set=values, pick=pick)
    talk.say(type="ask", time=stamp, set=values, pick=pick)
    talk.say(type="cancel", what="try")
    answer = talk.until("answer")
    while answer["type"] == "error":
        assert answer["text"] == "the try was cancelled"
        answer = talk.until("answer")
    assert answer["set"] == values


def test_a_full_temporary_disk_is_told_with_its_folder(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with small_disk(tmp_path / "small", "1m") as small:
        monkeypatch.setattr(tempfile, "tempdir", str(small))
        with served(bag) as address, Talk(address) as talk:
            error = talk.over["error"] if talk.over["type"] == "progress" else talk.over["text"]
    full = (
        f"{small}: the disk is full: make room there, or name another folder for temporary files with TMPDIR"
    )
    assert error == full

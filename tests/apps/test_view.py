"""The page of a run in a real browser: it shows the data and requests nothing from the network."""

import dataclasses
import itertools
import json
import os
import struct
import zlib

import h5py
import numpy as np
import pytest
from browser import chromium, opened, until
from oracles import rotation
from recordings import flown, separated, swinging
from scipy.spatial.transform import Rotation

import echelon as ech
from echelon.agents.network.switching import Schedule
from echelon.core.errors import OutputError
from echelon.experiments.results.recording import recording_of
from echelon.output.plots.space import space_of
from echelon.output.viewer.page import Group, pack
from echelon.output.viewer.replay import (
    Growing,
    frames_of,
    growing_page,
    guarantee_badge,
    header,
    link_shades,
    replay_data,
    replay_page,
)
from echelon_flight.page_server import Handler


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def run():
    return flown()


@pytest.fixture(scope="module")
def file(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "run.html"
    path.write_text(replay_page(run), "utf-8")
    return path.as_uri()


@pytest.fixture
def drawn(browser, tmp_path):
    def open_page(*runs, **options):
        path = tmp_path / "run.html"
        path.write_text(replay_page(*runs), "utf-8")
        return opened(browser, path.as_uri(), **options)

    return open_page


def seek(page, frame):
    page.evaluate(f"echelon.seek({frame})")
    assert page.evaluate("echelon.frame") == frame


def text_of(page, place, number=0):
    """The words in a part of the page, in one line."""
    return page.locator(place).nth(number).inner_text().replace("\n", " ")


def test_scrubbing_shows_places_attitudes_and_goals_beside_the_leader(browser, run, file):
    with opened(browser, file) as page:
        for frame in (0, 37, 150, 300):
            seek(page, frame)
            for agent in range(4):
                place = run.states[frame, agent, :3]
                # Half a step of 16 bits over some 4 m, and the float32 of the page.
                assert page.evaluate(f"echelon.position({agent})") == pytest.approx(place, abs=6e-5)
                shown = Rotation.from_quat(page.evaluate(f"echelon.turn({agent})")).as_matrix()
                wanted = rotation(run.states[frame, agent, 6:9])
                np.testing.assert_allclose(shown, wanted, atol=1e-4)
                goal = run.states[frame, 0, :3] + run.offsets[agent, :3] - run.offsets[0, :3]
                assert page.evaluate(f"echelon.goal({agent})") == pytest.approx(goal, abs=1e-4)


def test_every_link_shown_is_a_link_of_the_graph_and_is_drawn_between_its_agents(
    browser, run, file
):
    with opened(browser, file, color_scheme="light") as page:
        # In formation, so that no body is in front of a link.
        seek(page, 300)
        assert page.evaluate("echelon.links") == run.edges.tolist()
        ends = [page.evaluate(f"echelon.whereOnScreen({k})") for k in run.edges[0]]
        x, y = np.mean(ends, axis=0)
        assert darkest(page, x, y) < 140
        page.get_by_role("button", name="links").click()
        assert darkest(page, x, y) > 140


ARROWS = {
    "edges": np.array([[0, 1], [1, 2], [3, 2], [0, 3]]),
    "heard": np.array([[False, True], [False, True], [True, True], [False, False]]),
    "schedule": Schedule(
        np.array([0.0, 2.0]), np.array([[1.0, 1.0, 0.0, 1.0], [0.0, 1.0, 2.0, 1.0]]), 3.0
    ),
}


def test_arrows_go_to_who_hears_and_a_graph_that_switches_has_the_links_of_the_time(drawn):
    run = flown(**ARROWS)
    with drawn(run, color_scheme="light") as page:
        for time in (0.0, 1.98, 2.0, 2.98, 3.0, 5.5):
            seek(page, round(50 * time))
            assert page.evaluate("echelon.links") == run.edges[run.linked(time)].tolist()
        seek(page, 275)
        heard = [page.evaluate(f"echelon.player.view.sendersOf({k})") for k in range(4)]
        assert heard == [[], [], [1, 3], [2]]
        # The head of the arrow from 1 to 2 is wide where its line is not.
        first, second = (np.array(page.evaluate(f"echelon.whereOnScreen({k})")) for k in (1, 2))
        way = second - first
        aside = 4.0 * np.array([-way[1], way[0]]) / np.linalg.norm(way)
        parts = {k: darkest(page, *(first + k * way + aside), 1) for k in np.arange(0.4, 0.9, 0.04)}
        assert min(x for k, x in parts.items() if k > 0.55) < 140
        assert all(x > 140 for k, x in parts.items() if k < 0.5)


def darkest(page, x, y, reach=4):
    """The darkest grey near a place of the scene, with nothing but links in sight."""
    page.evaluate("""for (const button of document.querySelectorAll('.toggle[aria-pressed=true]'))
        if (button.textContent !== 'links') button.click()""")
    return page.evaluate(
        """([x, y, r]) => new Promise((done) => requestAnimationFrame(() => {
        const view = echelon.player.view;
        view.render();
        const flat = document.createElement('canvas');
        const from = view.renderer.domElement, scale = from.width / from.clientWidth;
        const n = 2 * r + 1;
        Object.assign(flat, { width: n, height: n });
        const pen = flat.getContext('2d');
        pen.fillStyle = 'white';
        pen.fillRect(0, 0, n, n);
        pen.drawImage(from, x * scale - r, y * scale - r, n, n, 0, 0, n, n);
        done(Math.min(...pen.getImageData(0, 0, n, n).data.filter((_, k) => k % 4 === 1)));
    }))""",
        [x, y, reach],
    )


def test_the_charts_tell_the_error_and_v_at_the_cursor(browser, run, file):
    with opened(browser, file) as page:
        seek(page, 100)
        errors, told = run.formation_errors[100], [text_of(page, ".chart", k) for k in (0, 1)]
        assert [f"{errors[k]:.3g}" in told[0] for k in (1, 2, 3)] == [True] * 3
        assert f"V {run.lyapunov[100]:.3g}" in told[1]
        assert "guaranteed slope, \u22120.5 1/s" in told[0]
        assert "guaranteed slope, \u22121 1/s" in told[1]


def test_what_is_not_finite_is_a_dash_and_a_word_and_never_a_zero(drawn, run):
    states, V = run.states.copy(), run.lyapunov.copy()
    # Frame 100: no number; 150: infinite; 200: an error and V that are exactly 0.
    states[100, 2], states[150, 2], V[100], V[150], V[200] = np.nan, np.inf, np.nan, np.inf, 0.0
    states[200, 1] = states[200, 0] - run.offsets[0] + run.offsets[1]
    with drawn(dataclasses.replace(run, states=states, lyapunov=V)) as page:
        for frame in (100, 150):
            seek(page, frame)
            shown = text_of(page, "#side")
            assert "2 \u2013 not finite" in shown and "V \u2013 not finite" in shown
            assert f"1 {run.formation_errors[frame, 1]:.3g}" in shown
        seek(page, 100)
        assert page.evaluate("echelon.whereOnScreen(2)") is None
        labels = page.locator(".label").all()
        assert [label.is_visible() for label in labels] == [True, True, False, True]
        page.evaluate("(echelon.player.view.selected = 2, echelon.seek(100))")
        assert page.locator(".card").inner_text().count("\u2013 not finite") == 2
        seek(page, 200)
        shown = text_of(page, "#side")
        assert "1 < 1.0\u00b710\u207b\u00b9\u2077" in shown
        assert "V < 1.0\u00b710\u207b\u00b3\u2074" in shown


def test_a_click_on_an_agent_tells_its_place_its_error_and_whom_it_hears(browser, run, file):
    with opened(browser, file) as page:
        seek(page, 60)
        x, y = page.evaluate("echelon.whereOnScreen(2)")
        box = page.locator("#scene").bounding_box()
        page.mouse.click(box["x"] + x, box["y"] + y)
        until(lambda: page.locator(".card").is_visible())
        card = page.locator(".card").inner_text()
        assert card.startswith("follower 2\n") and "receives from 0" in card
        error = run.formation_errors[60, 2]
        assert f"{error:.3g}"[:4] in card


def test_keys_the_slider_and_a_chart_move_the_time_and_play_lets_it_run(browser, file):
    with opened(browser, file) as page:
        page.keyboard.press("ArrowRight")
        assert page.evaluate("echelon.run.moment.time") == pytest.approx(0.1, abs=1e-6)
        page.keyboard.press("End")
        assert page.evaluate("echelon.frame") == 300
        area = page.locator(".chart .area").first.bounding_box()
        page.mouse.click(area["x"] + 46, area["y"] + 20)
        assert page.evaluate("echelon.frame") == pytest.approx(0.0, abs=2.0)
        page.keyboard.press(" ")
        until(lambda: page.evaluate("echelon.frame") > 10)
        page.keyboard.press(" ")
        stopped = page.evaluate("echelon.frame")
        assert not page.evaluate("echelon.player.playing") and stopped < 300


TURN = """([place, shift]) => {
    const { orbit } = echelon.player.views.views[place];
    orbit.target.x += shift;
    orbit.update();
}"""


def shown_span(page):
    return page.evaluate("echelon.player.window.span")


def test_a_chart_is_zoomed_and_moved_with_its_numbers_and_a_double_click_shows_all(browser, file):
    with opened(browser, file) as page:
        seek(page, 150)
        page.locator("h1").click()
        box = page.locator(".chart .area").first.bounding_box()
        middle, height = box["x"] + 46 + 0.5 * (box["width"] - 60), box["y"] + 0.5 * box["height"]
        page.mouse.move(middle, height)
        page.mouse.wheel(0, -600)
        until(lambda: shown_span(page)[1] < 6.0)
        low, high = shown_span(page)
        # The time under the mouse stays.
        assert high - low == pytest.approx(6.0 * 1.0015**-600, rel=1e-3)
        assert 0.5 * (low + high) == pytest.approx(3.0, abs=0.05)
        reach = page.evaluate("echelon.player.charts.map((c) => c.limits)")
        page.mouse.move(middle + 80, height)
        page.mouse.down()
        page.mouse.move(middle - 20, height)
        page.mouse.up()
        assert shown_span(page)[0] > low and page.evaluate("echelon.frame") == 150
        # Over the numbers at the left it is the values that are stretched.
        page.mouse.move(box["x"] + 20, height)
        page.mouse.wheel(0, 300)
        until(lambda: page.evaluate("echelon.player.charts[0].limits") != reach[0])
        assert page.locator(".reset").first.is_visible()
        page.mouse.dblclick(middle, height)
        assert shown_span(page) == [0, 6] and not page.locator(".reset").first.is_visible()


def test_keys_choose_an_agent_and_are_listed_and_the_address_is_a_link_to_the_time(browser, file):
    with opened(browser, file + "#t=1.5") as page:
        assert page.evaluate("echelon.run.moment.time") == pytest.approx(1.5)
        for key, agent in (("n", 0), ("n", 1), ("p", 0), ("p", 3), ("Escape", -1)):
            page.keyboard.press(key)
            assert page.evaluate("echelon.player.view.selected") == agent
        assert not page.locator(".report").is_visible()
        page.keyboard.press("?")
        told = page.locator("#help").inner_text()
        assert "select the next agent" in told and "play, pause" in told
        page.keyboard.press("?")
        assert not page.locator("#help").is_visible()
        page.keyboard.press("ArrowRight")
        until(lambda: page.evaluate("location.hash") == "#t=1.6")
        page.evaluate("location.hash = 't=2.25'")
        until(lambda: page.evaluate("echelon.run.moment.time") == pytest.approx(2.25))


def test_the_camera_follows_an_agent_and_those_out_of_view_are_counted_and_shown_again(
    browser, file
):
    with opened(browser, file) as page:
        hint = page.locator(".away")
        assert not hint.is_visible()
        page.evaluate(TURN, [0, 50])
        until(lambda: hint.is_visible())
        assert hint.inner_text().startswith("4 agents out of view")
        hint.click()
        until(lambda: not hint.is_visible())
        page.get_by_label("target of the camera").select_option("3")
        places = []
        for frame in (0, 120):
            seek(page, frame)
            page.evaluate("echelon.player.view.render()")
            places.append(page.evaluate("echelon.whereOnScreen(3)"))
        assert places[0] == pytest.approx(places[1], abs=0.5)


def test_the_smallest_distance_so_far_has_its_pair_its_time_and_the_size_of_vehicles(drawn, run):
    states = run.states.copy()
    # Nobody is closer before frame 120, where 2 meets 3.
    states[120, 2, :3] = states[120, 3, :3] + [0.0, 0.1, 0.0]
    met = dataclasses.replace(run, states=states, radius=0.07)
    places = states[:, :, :3]
    with drawn(met) as page:
        for frame in (40, 119, 120, 300):
            seek(page, frame)
            pairs = itertools.combinations(range(4), 2)
            apart = {(i, j): np.linalg.norm(places[:, i] - places[:, j], axis=1) for i, j in pairs}
            i, j = min(apart, key=lambda pair: apart[pair][: frame + 1].min())
            least = apart[i, j][: frame + 1]
            shown = page.locator(".closest")
            number = f"{least.min():#.3g}"
            words = f"so far {number} m, agents {i} and {j} at {run.times[least.argmin()]:.2f} s"
            assert words in shown.inner_text() and "touch below 0.140 m" in shown.inner_text()
            assert ("touch" in shown.get_attribute("class").split()) == (frame >= 120)
        seek(page, 80)
        told, least = text_of(page, ".chart", 2), met.least_distances([80])[0]
        assert "smallest distance, m" in told and f"any two {least:#.3g}"[:12] in told
        # Twice the radius.
        assert page.evaluate("echelon.run.charts[2].marks.map((mark) => mark.value)") == [0.14]
        assert page.evaluate("echelon.player.view.ellipsoids.shown.value") == 0


MARKS = "[...echelon.player.view.ellipsoids.marks(echelon.run.moment.position)]"
"""Of each agent 2 below the kept distance, 4 where ellipsoids overlap, else 0."""


def test_ellipsoids_are_marked_below_the_limit_and_the_chart_has_distance_and_rows(drawn, run):
    states = run.states.copy()
    # Scaled to a third in height: .267 m between the limits, .233 m overlapping, .333 m beyond.
    for frame, high in ((100, 0.8), (150, 0.7), (200, 1.0)):
        states[frame, 2, :3] = states[frame, 3, :3] + [0.0, 0.0, high]
    with drawn(separated(dataclasses.replace(run, states=states))) as page:
        for frame, mark in ((100, 2), (150, 4), (200, 0)):
            seek(page, frame)
            assert page.evaluate(MARKS) == [0, 0, mark, mark]
            told = text_of(page, ".chart", 2)
            second = frame // 50
            assert f"any two {0.3 + 0.1 * second:#.3g}" in told
            assert f"active rows {6.0 - second:.2f}" in told
        assert "smallest scaled distance, m" in told
        shown = page.locator(".closest").inner_text()
        scaled = states[:, :, :3] * [1.0, 1.0, 1.0 / 3.0]
        gaps = np.linalg.norm(scaled[:, :, None] - scaled[:, None], axis=3) + 9.0 * np.eye(4)
        least = f"{gaps[:201].min():#.3g} m"
        assert shown.startswith(
            f"overlap: smallest scaled distance in the frames so far {least}, agents "
        )
        assert page.evaluate("echelon.player.view.ellipsoids.shown.value") == 1
        page.get_by_role("button", name="ellipsoids").click()
        assert page.evaluate("echelon.player.view.ellipsoids.shown.value") == 0


def test_who_is_lost_vanishes_a_backup_leader_leads_and_the_event_is_marked(drawn, run):
    starts, weights = np.array([0.0, 2.0]), np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    here = np.array([[True] * 4, [False, True, True, True]])
    schedule = Schedule(starts, weights, None, here, np.array([[0] * 4, [1] * 4]))
    lost = dataclasses.replace(
        run,
        schedule=schedule,
        reference=run.states[:, 0].copy(),
        events=({"at": 2.0, "text": "agent 0 is lost"},),
    )
    with drawn(lost) as page:
        seek(page, 99)
        assert page.evaluate("echelon.whereOnScreen(0)") is not None
        assert page.locator(".moment").inner_text() == ""
        seek(page, 100)
        assert page.evaluate("echelon.whereOnScreen(0)") is None
        assert page.locator(".moment").inner_text() == "2.00 s: agent 0 is lost"
        assert page.locator("footer .mark").get_attribute("title") == "agent 0 is lost"
        names = page.evaluate("[...document.querySelectorAll('.label')].map((x) => x.innerText)")
        assert names[1:] == ["leader", "2", "3"]
        # Goals are relative to the backup leader, and errors are of those that are there.
        goal = run.states[100, 1, :3] + run.offsets[2, :3] - run.offsets[1, :3]
        assert page.evaluate("echelon.goal(2)") == pytest.approx(goal, abs=1e-4)
        away = np.linalg.norm(run.states[100, 2, :3] - goal)
        shown = text_of(page, ".chart")
        assert f"2 {away:#.3g}" in shown and "1 \u2013 leads" in shown
        seek(page, 50)
        assert page.evaluate("echelon.run.leaders") == [0]


NAME = "</title><script>window.broken = 1</script><b>&amp;"


def test_the_reference_and_goals_that_move_are_drawn_and_a_name_is_no_code(drawn, run):
    reference, moving = run.states[:, 0].copy(), np.tile(run.offsets, (len(run.times), 1, 1))
    reference[:, 1] += 0.25
    moving[:, 2, 1] += 0.3 * run.times
    with drawn(dataclasses.replace(run, reference=reference, moving=moving, name=NAME)) as page:
        assert page.locator("h1").inner_text() == NAME and not page.evaluate("window.broken")
        for frame in (0, 300, 90):
            seek(page, frame)
            goal = run.states[frame, 0, :3] + moving[frame, 2, :3] - moving[frame, 0, :3]
            assert page.evaluate("echelon.goal(2)") == pytest.approx(goal, abs=2e-4)
        assert page.evaluate("echelon.goal(0)") == pytest.approx(reference[90, :3], abs=1e-4)
        assert "leader 0.250" in text_of(page, ".chart")
        page.keyboard.press("n")
        assert "0.250 m from its reference" in page.locator(".card").inner_text()
        places = page.evaluate("echelon.run.path")
        np.testing.assert_allclose(places[90], reference[90, :3], atol=1e-4)


def test_two_runs_have_one_clock_one_scale_and_one_camera(browser, run, tmp_path):
    other = flown(seconds=3.0, rate=25.0)
    path = tmp_path / "runs.html"
    both = other, dataclasses.replace(run, name="second")
    path.write_text(replay_page(*both, reports=["one\n---\n- <first>", "two"]), "utf-8")
    moments = "echelon.player.panes.map((pane) => pane.run.moment.time)"
    with opened(browser, path.as_uri()) as page:
        assert page.locator("header h1").inner_text() == "made up and second"
        for k, text in enumerate(("one\n---\n- <first>", "two")):
            page.locator(".report").nth(k).click()
            assert page.locator("dialog pre").inner_text() == text
            page.keyboard.press("End")
            page.locator("dialog button").click()
            until(lambda: not page.locator("dialog").count())
        assert page.evaluate(moments) == [0.0, 0.0]
        for time, shown in ((2.0, [2.0, 2.0]), (5.0, [3.0, 5.0])):
            page.evaluate(f"echelon.player.seekTime({time})")
            assert page.evaluate(moments) == pytest.approx(shown)
        limits = page.evaluate("echelon.player.charts.map((chart) => chart.limits)")
        assert limits[:3] == limits[3:]
        page.evaluate(TURN, [1, 1])
        targets = page.evaluate("echelon.player.views.views.map((v) => v.orbit.target.toArray())")
        assert targets[0] == pytest.approx(targets[1])
        page.keyboard.press("n")
        assert page.locator(".card").count() == 2 and page.locator(".card").last.is_visible()
    with opened(browser, path.as_uri(), 390, 844) as page:
        cut = "(names) => names.map((name) => name.scrollWidth > name.clientWidth)"
        assert page.locator("main h1").evaluate_all(cut) == [False, False]


def test_a_phone_shows_scene_and_controls_on_one_screen_with_room_for_fingers(browser, file):
    with opened(browser, file, 390, 844, has_touch=True, is_mobile=True) as page:
        assert page.evaluate("document.documentElement.scrollHeight") <= 844
        boxes = {name: page.locator(name).bounding_box() for name in ("#scene", "#side", "footer")}
        assert boxes["#scene"]["y"] + boxes["#scene"]["height"] <= boxes["#side"]["y"] + 0.5
        assert boxes["#side"]["y"] + boxes["#side"]["height"] <= boxes["footer"]["y"] + 0.5
        assert boxes["footer"]["y"] + boxes["footer"]["height"] <= 844.5
        for target in page.locator("button:visible, select:visible, input:visible").all():
            box = target.bounding_box()
            assert min(box["width"], box["height"]) >= 44
        # A finger that moves up scrolls the charts, and seeks no time.
        touch = page.locator(".area").first.evaluate("(e) => getComputedStyle(e).touchAction")
        assert touch == "pan-y"


def test_nothing_is_cut_off_on_narrow_and_wide_screens(browser, file):
    for width, height in ((420, 800), (1600, 900)):
        with opened(browser, file, width, height) as page:
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            for name in ("header", "#scene", "#play", "#scrub"):
                box = page.locator(name).bounding_box()
                assert box["x"] >= 0 and box["x"] + box["width"] <= width + 0.5
                assert box["width"] > 10 and box["height"] > 10


def parts_of(run, cuts):
    names = ("times", "states", "inputs", "lyapunov", "reference")
    for a, b in itertools.pairwise(cuts):
        yield dataclasses.replace(run, **{name: getattr(run, name)[a:b] for name in names})


def test_a_page_is_fed_while_a_run_is_computed_and_shows_the_whole_run_at_its_end(browser, run):
    run = dataclasses.replace(run, reference=run.states[:, 0] + 0.1)
    growing = Growing(run)
    first, second, third = parts_of(run, (0, 90, 91, 301))
    with growing_page(growing).serving(0) as address, opened(browser, address) as page:
        assert page.evaluate("echelon.run.growing") and page.evaluate("echelon.last") == 0
        growing.add(first)
        until(lambda: page.evaluate("echelon.last") == 89)
        # Who looks at the newest frame goes on to.
        assert page.evaluate("echelon.frame") == 89
        assert f"Computed until {run.times[89]:.1f} of" in page.locator(".notes").inner_text()
        growing.add(second)
        until(lambda: page.evaluate("echelon.last") == 90)
        seek(page, 40)
        growing.add(third)
        until(lambda: page.evaluate("echelon.last") == 300)
        assert page.evaluate("echelon.frame") == 40
        for frame in (0, 40, 89, 90, 91, 300):
            seek(page, frame)
            assert page.evaluate("echelon.run.moment.time") == pytest.approx(run.times[frame])
            for agent in (0, 3):
                place = run.states[frame, agent, :3]
                assert page.evaluate(f"echelon.position({agent})") == pytest.approx(place, abs=6e-5)
            goal = run.reference[frame, :3]
            assert page.evaluate("echelon.goal(0)") == pytest.approx(goal, abs=6e-5)
            pair = dataclasses.replace(
                run, times=run.times[: frame + 1], states=run.states[: frame + 1]
            ).closest_pair()
            told = f"{pair.distance:#.3g} m, agents {pair.agents[0]} and {pair.agents[1]}"
            assert told in page.locator(".closest").inner_text()
        seek(page, 120)
        chart = text_of(page, ".chart", 1)
        assert f"V {run.lyapunov[120]:.3g}" in chart and "guaranteed slope, −1 1/s" in chart
        with page.expect_event("load"):
            growing.finish(run, "all of it")
        # A time in between, so that the frame is rounded.
        shown = "Math.round(window.echelon?.frame) === 120 && !echelon.run.growing"
        until(lambda: page.evaluate(shown))
        page.locator(".report").click()
        assert page.locator("dialog pre").inner_text() == "all of it"


OTHERS = {
    "plane": (swinging(("x", "y", "heading"), (0, 1), n=3), "plane", "car"),
    "side": (swinging(("y", "z", "roll"), (0, 1), n=3), "plane", "birotor"),
    "phase": (swinging(("angle", "rate"), ()), "phase", "dot"),
    "time": (swinging(("x", "vx"), (0,)), "time", "dot"),
    "point": (swinging(("x", "y", "z"), (0, 1, 2), n=3), "space", "ball"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_models_are_drawn_in_their_own_space(drawn, name):
    run, kind, shape = OTHERS[name]
    space = space_of(run)
    assert (space.kind, space.shape) == (kind, shape)
    with drawn(run) as page:
        seek(page, 40)
        shown = np.array([page.evaluate(f"echelon.position({k})") for k in range(3)])
        wanted = run.states[40][:, list(space.axes)]
        if kind == "time":
            wanted = np.column_stack([np.full(3, run.times[40]), wanted])
        k = min(2, wanted.shape[1])
        stretched = wanted[:, :k] * space.stretch
        np.testing.assert_allclose(shown[:, :k], stretched, atol=2e-4)
        for agent in range(3):
            x, y = page.evaluate(f"echelon.whereOnScreen({agent})")
            box = page.locator("#scene").bounding_box()
            assert 0 <= x <= box["width"] and 0 <= y <= box["height"]
        if name == "side":
            # A turn in the plane goes from the first axis to the second.
            turn = Rotation.from_quat(page.evaluate("echelon.turn(1)")).as_matrix()
            np.testing.assert_allclose(turn, rotation([0, 0, run.states[40, 1, 2]]), atol=1e-3)


def unpacked(block):
    """What `pack` made, read by a second implementation."""
    raw = zlib.decompress(block)
    (length,) = struct.unpack("<I", raw[:4])
    header, at, found = json.loads(raw[4 : 4 + length]), 4 + length, {}
    for name, group in header["groups"].items():
        shape = (len(group["low"]), group["frames"])
        size = shape[0] * shape[1]
        d = np.frombuffer(raw, np.uint8, size * group["bytes"], at).astype(np.int64)
        at += size * group["bytes"]
        d = d[:size] + (d[size:] << 8 if group["bytes"] == 2 else 0)
        q = np.cumsum(d.reshape(shape), axis=1) % 256 ** group["bytes"]
        found[name] = np.array(group["low"]) + q.T * np.array(group["step"])
    assert at == len(raw)
    return header, found


def test_numbers_come_back_within_half_a_step_of_their_own_range():
    rng = np.random.default_rng(1)
    values = np.cumsum(rng.normal(size=(200, 5)), axis=0) * np.geomspace(1e-6, 1e6, 5)
    values[:, 4] = 3.0
    _, found = unpacked(pack({}, {"fine": Group(values), "byte": Group(values, 255)}))
    reach = np.ptp(values, axis=0)
    for name, levels in (("fine", 65535), ("byte", 255)):
        off = np.abs(found[name] - values).max(axis=0)
        assert (off <= 0.5001 * reach / levels + 1e-8 * np.abs(values).max(axis=0)).all()


def test_frames_are_at_most_50_a_second_and_end_with_the_last(run):
    fast = flown(seconds=1.005, rate=200.0)
    frames = frames_of(fast)
    assert fast.times[frames[1]] == pytest.approx(0.02)
    assert frames[-1] == len(fast.times) - 1
    assert list(frames_of(run)) == list(range(301))


SIZES = [
    (4, 60.0, (0,), 0.5e6),
    pytest.param(1000, 20.0, tuple(range(0, 1000, 25)), 3e6, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("agents", "seconds", "leaders", "most"), SIZES)
def test_a_page_is_small(agents, seconds, leaders, most):
    assert len(replay_page(flown(agents, seconds, leaders=leaders))) <= most


def test_agents_that_fly_away_spoil_neither_the_scale_nor_the_rest():
    run = flown()
    states = run.states.copy()
    states[200:, 3] *= 1e200
    gone = dataclasses.replace(run, states=states)
    space = space_of(gone)
    assert space.clipped and (space.high - space.low).max() < 20.0
    header, found = unpacked(replay_data(gone))
    assert "drawn at that border" in " ".join(header["notes"])
    places = found["positions"].reshape(-1, 4, 3)
    np.testing.assert_allclose(places[:200], run.states[:200, :, :3], atol=1e-3)


def test_a_run_without_frames_is_refused(run):
    empty = {name: getattr(run, name)[:0] for name in ("times", "states", "inputs")}
    with pytest.raises(OutputError, match="no stored frame"):
        replay_data(dataclasses.replace(run, **empty))


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    model, graph = ech.models.SingleIntegrator(dimension=2), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain("identity", coupling=2.0))
    places = ech.Formation.from_offsets(model, graph, {1: [1, 0], 2: [2, 0]})
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, "relay"))
    parts = ech.Parts(model, graph, places, laws, {"position": 1.0})
    result = ech.simulate(parts, ech.Settings(horizon=1.0, dt=0.01))
    path = tmp_path_factory.mktemp("stored") / "run.nc"
    ech.save_dataset(result, path)
    return result, path


def test_what_is_read_from_a_file_is_what_ran(stored):
    result, _ = stored
    run = recording_of(result)
    np.testing.assert_array_equal(run.states, result.states)
    np.testing.assert_array_equal(run.errors, result.errors)
    assert run.position == (0, 1) and run.length_unit == "m"
    assert run.heard.tolist() == [[False, True], [True, True]] and run.schedule is None
    assert run.nearest.tolist() == list(result.graph.nearest_leader())
    assert run.modes is not None and run.modes.poles.real.max() < 0.0


def test_view_writes_one_file_and_replaces_none_unasked(echelon, stored):
    words = "view", stored[1].parent, "--html", "out.html"
    code, told, _ = echelon("view", stored[1], *words[2:])
    assert code == 0 and told.startswith("- Written to out.html: 0.2")
    assert echelon(*words)[::2] == (
        2,
        "echelon: the file `out.html` exists; choose another, or `--force` to replace it.\n",
    )
    assert echelon(*words, "--force")[0] == 0


def test_view_without_a_run_takes_the_newest_and_at_most_two(echelon, here, stored):
    code, _, fault = echelon("view", "--html", "out.html")
    assert code == 2 and fault == (
        "echelon: there is no run in `runs/`; give the folder of a run.\n"
    )
    for age, name in enumerate(("newer", "older")):
        (here / "runs" / name).mkdir(parents=True)
        copy = here / "runs" / name / "run.nc"
        copy.write_bytes(stored[1].read_bytes())
        os.utime(copy, (1e9 - age, 1e9 - age))
    (here / "runs" / "empty").mkdir()
    code, _, told = echelon("view", "--html", "out.html")
    assert code == 0 and "echelon: showing `runs/newer`, the newest run.\n" in told
    assert echelon("view", "runs/newer", "runs/older", "--html", "two.html")[0] == 0
    text = (here / "two.html").read_text("utf-8")
    assert text.count('class="data"') == 2 and "newer and older" in text
    code, _, fault = echelon("view", "runs/newer", "runs/older", "runs/newer")
    assert code == 2 and "got 3 runs; a page shows one, or two beside each other." in fault


def test_what_is_no_run_is_refused_in_a_sentence(echelon, here, stored):
    (here / "junk.nc").write_bytes(stored[1].read_bytes()[:3000])
    (here / "old.nc").write_bytes(stored[1].read_bytes())
    with h5py.File(here / "old.nc", "r+") as old:
        del old.attrs["format"]
    for given, sentence in (
        (".", "the folder `.` holds no run: it has no `run.nc`."),
        ("junk.nc", "`junk.nc` cannot be read as a run: it is damaged, or was not written"),
        ("old.nc", "`old.nc`: the run has format 1, of echelon "),
    ):
        code, _, fault = echelon("view", given, "--html", "out.html")
        assert code == 2 and fault.startswith(f"echelon: {sentence}") and fault.count("\n") == 1
    assert not (here / "out.html").exists()


def test_a_notebook_shows_the_replay_in_a_cell_without_a_guarantee(browser, stored):
    result, _ = stored
    shown = result.view(height=400)
    assert "a notebook shows it" in repr(shown)

    class Notebook(Handler):
        head = "<link rel='icon' href='data:,'><script>window.echelon = 1</script>"
        page = (head + shown._repr_html_()).encode()

    with Notebook.serving(0) as address, opened(browser, address) as page:
        cell = page.frames[1]
        until(lambda: cell.evaluate("Boolean(window.echelon)"))
        cell.evaluate("echelon.seek(echelon.last)")
        place = result.states[-1, 1, :2]
        assert cell.evaluate("echelon.position(1)")[:2] == pytest.approx(place, abs=1e-4)
        assert not cell.locator(".promise").is_visible()
        assert "Lyapunov function V" in cell.locator("#side").inner_text()


def test_the_badge_says_which_rate_it_has_and_is_not_green_over_a_run_that_was_lost(run):
    told, mode = run.guarantee, {"value": -1.32, "unit": "1/s", "rounding": "up"}
    assert "rate          0.5 1/s eventually" in guarantee_badge(told)["whole"]
    both = told | {"numbers": told["numbers"] | {"slowest_mode": mode}}
    assert "the slowest mode alone decays at 1.32 1/s" in " ".join(
        guarantee_badge(both)["whole"].split()
    )
    apart = told | {"claim": "apart", "theorem": "T10", "numbers": {}}
    badge = guarantee_badge(apart)
    assert (badge["state"], badge["short"]) == ("holds", "guaranteed: agents stay apart, T10")
    for outcome, state in (("completed", "holds"), ("left_chart", "lost"), ("diverged", "lost")):
        ended = dict(run.attributes) | {"outcome": outcome, "message": "It ended so."}
        drawn = dataclasses.replace(run, attributes=ended)
        assert header(drawn, space_of(run))["promise"]["state"] == state


def test_links_fade_with_age_and_flash_for_a_lost_message():
    heard = np.array([[False, True], [True, True], [False, False]])
    ages = np.array([[np.nan, 0.1], [0.3, 0.2], [np.nan, np.nan]])
    lost = np.zeros((3, 2), int)
    assert link_shades(ages, lost, 0.4, heard) == pytest.approx([0.75, 0.25, 1.0])
    # The older of two, none yet, and nobody who hears.
    ages[1, 0], lost[0, 1] = np.nan, 2
    assert link_shades(ages, lost, 0.4, heard).tolist() == [2.0, 0.0, 1.0]

"""The page's sounds and voice, in a real browser."""

import time

import pytest

from lce_rig.collect.live.state import Cue

from .conftest import state
from .screen import OPEN, has_text, shown

pytestmark = pytest.mark.realtime


def test_sounds_are_played_once_each_after_a_tap(preview, browser):
    counting = """
      window.tones = [];
      const make = AudioContext.prototype.createOscillator;
      AudioContext.prototype.createOscillator = function () {
        const made = make.call(this);
        const start = made.start;
        made.start = function (when) { window.tones.push(made.frequency.value); start.call(made, when); };
        return made;
      };
    """
    page = browser.open(preview.urls[0], first=counting)
    shown(preview, page, has_text("count", "7"))
    shown(preview, page, has_text("count", "8"), n_captures=8, cues=(Cue(3, "enough"),))
    assert page.evaluate("window.tones") == []
    page.tap("sound")
    page.wait_until("document.getElementById('sound').getAttribute('aria-pressed') === 'true'")
    page.wait_until("window.tones.length === 1")
    cues = (Cue(3, "enough"), Cue(4, "captured"), Cue(5, "refused"))
    for k in range(3):
        shown(preview, page, has_text("count", str(9 + k)), n_captures=9 + k, cues=cues)
    assert page.evaluate("window.tones") == [1000, 880, 1320, 220, 185]
    shown(preview, page, has_text("count", "12"), n_captures=12, cues=(*cues, Cue(6, "lost")))
    assert page.evaluate("window.tones.length") == 8
    page.tap("sound")
    shown(preview, page, has_text("count", "13"), n_captures=13, cues=(Cue(7, "tick"),))
    assert page.evaluate("window.tones.length") == 8
    assert not page.complaints


@pytest.mark.long
def test_voice_reads_settled_words_once(preview, browser):
    # Headless browsers have no voices: this one records the text.
    listening = """
      window.said = [];
      const voice = {
        speaking: false, getVoices: () => [{ lang: 'en-GB', localService: true }],
        addEventListener() {}, cancel() {}, speak: (words) => window.said.push(words.text),
      };
      Object.defineProperty(window, 'speechSynthesis', { value: voice });
      window.SpeechSynthesisUtterance = class { constructor(text) { this.text = text; } };
    """
    page = browser.open(preview.urls[0], first=listening)
    page.wait_until(OPEN)

    def stand(headline, phase, duration_s):
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            preview.publish(state(headline=headline, phase=phase, drawing=None))
            time.sleep(0.1)

    stand("raise it 20 cm", "moving", 1.0)
    assert page.evaluate("window.said") == []
    page.tap("speech")
    for distance in range(8):
        stand(f"0.{9 - distance} m closer", "moving", 0.1)
    instruction = "one step left"
    stand(instruction, "moving", 2.0)
    stand("hold still", "holding", 1.2)
    page.wait_until(has_text("headline", "hold still"))
    assert page.evaluate("window.said") == [instruction]
    assert not page.complaints

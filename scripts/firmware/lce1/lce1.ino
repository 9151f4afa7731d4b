// LCE1 sync board: pulse per second and GPRMC for a VLP-16, trigger pulses for cameras, and a line to the
// computer about each of them. Written for a Teensy 4.0 or 4.1 (3.3 V, serial output that can be inverted in
// hardware); for others see README.md. Not yet tried on hardware.

#include "board.h"

// The VLP-16 listens to RS-232 polarity: the line rests low. Teensy inverts it in hardware.
#define LIDAR_SERIAL Serial1  // transmits on pin 1

namespace {

const uint8_t kPins[lce1::kChannels + 1] = {3, 4, 5, 6, 2};  // channels 0 to 3, then the pulse per second
const uint32_t kTickUs = 10;

void write_pin(uint8_t line, bool is_high) { digitalWriteFast(kPins[line], is_high ? HIGH : LOW); }

lce1::Board board("teensy4", write_pin);
lce1::LongClock clock_us;
IntervalTimer timer;

void on_timer() { board.tick(clock_us.extend(micros())); }

// The main loop's reading of the clock that the interrupt keeps.
uint64_t now_us() {
  noInterrupts();
  const uint64_t now = clock_us.extend(micros());
  interrupts();
  return now;
}

}  // namespace

void setup() {
  for (uint8_t pin : kPins) {
    pinMode(pin, OUTPUT);
    digitalWrite(pin, LOW);
  }
  Serial.begin(115200);
  LIDAR_SERIAL.begin(9600, SERIAL_8N1_TXINV);
  timer.begin(on_timer, kTickUs);
}

void loop() {
  while (Serial.available() > 0) {
    if (board.receive(static_cast<char>(Serial.read()), now_us())) {
      const uint64_t now = now_us();
      noInterrupts();
      board.apply(now);
      interrupts();
      break;  // answer before the next line is read
    }
  }
  // A computer that does not read must never hold up the board: what it has no room for is dropped.
  const size_t length = board.next_line(now_us());
  if (length > 0) {
    if (static_cast<size_t>(Serial.availableForWrite()) >= length) {
      Serial.write(board.line(), length);
    } else {
      board.drop_line();
    }
  }
  const size_t sentence = board.next_sentence(now_us());
  if (sentence > 0) LIDAR_SERIAL.write(board.sentence(), sentence);
}

// The sync board itself: pulses, their running numbers, and the LCE1 protocol. Plain C++ without a single
// Arduino call, so that it runs on a computer as well; docs/sync-protocol.md says what the lines mean.
//
// Two callers share a board. `tick` belongs to a timer interrupt: it sets pins and notes edges. Everything
// else belongs to the main loop. They meet in a queue that each of them writes at one end only, and in
// `apply`, during which the loop holds interrupts off.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "sentence.h"

namespace lce1 {

constexpr char kFirmware[] = "1.0";
constexpr uint8_t kVersion = 1;
constexpr uint8_t kChannels = 4;
constexpr uint8_t kPpsLine = kChannels;  // after the channels
constexpr uint32_t kSecondUs = 1000000;
constexpr uint32_t kPpsHighUs = 100000;
// A VLP-16 wants the sentence from 50 ms after the pulse has fallen to 600 ms after it rose.
constexpr uint32_t kSentenceAfterUs = 250000;
constexpr uint32_t kMaxSlewUs = 50;      // by how much a second may be longer or shorter: 50 ppm
constexpr uint32_t kMaxSlewedUs = 5000;  // what is farther off is set at once
constexpr uint64_t kMaxRateUhz = 1000000000;
constexpr uint64_t kMaxUs = 9223372036854775ULL;  // fits into 64 bits as nanoseconds

// Sets a line; called from `tick`.
typedef void (*WritePin)(uint8_t line, bool is_high);

class Board {
 public:
  Board(const char* name, WritePin write_pin) : name_(name), write_pin_(write_pin) {}

  // Timer interrupt: sets every pin whose time has come. Call it as often as pulses are to be exact.
  void tick(uint64_t now_us);

  // Main loop: takes a character from the computer; true when a line is complete and waits for `apply`.
  bool receive(char c, uint64_t now_us);

  // Main loop, interrupts off: does what the received line says.
  void apply(uint64_t now_us);

  // Main loop: the next line for the computer, valid until the next call; 0 where there is none.
  size_t next_line(uint64_t now_us);
  const char* line() const { return out_.data(); }

  // Main loop: the computer did not take the line; it is lost.
  void drop_line() { ++n_lost_; }

  // Main loop: the next sentence for the LiDAR, valid until the next call; 0 until one is due.
  size_t next_sentence(uint64_t now_us);
  const char* sentence() const { return rmc_.data(); }

 private:
  enum class EdgeKind : uint8_t { kPps, kRise, kFall };
  struct Edge {
    EdgeKind kind;
    uint8_t channel;
    uint32_t count;
    uint64_t t_us;
    uint64_t utc_s;  // 0 where not known
  };
  struct Channel {
    uint64_t rate_uhz = 0;  // 0 where unused
    uint32_t phase_us = 0;
    uint32_t pulse_us = 0;
    uint32_t count = 0;
    uint64_t next_us = 0;
    uint64_t fall_us = 0;
    uint64_t fraction = 0;      // of a microsecond, in units of 1 / rate_uhz
    uint32_t n_left = 0;        // pulses until the next second, for rates in whole hertz
    uint64_t origin_us = 0;     // the second that the pulses are counted from
    bool is_high = false;
    bool is_waiting = true;     // for a second to begin
  };
  enum class Reply : uint8_t { kNone, kHello, kTime, kError };

  void tick_pps(uint64_t now_us);
  void tick_channel(uint8_t index, uint64_t now_us);
  void push(EdgeKind kind, uint8_t channel, uint32_t count, uint64_t t_us, uint64_t utc_s);
  bool pop(Edge* edge);
  void set_trigger(const Fields& fields);
  void set_utc(uint64_t t_us, uint64_t utc_s, uint64_t now_us);
  void complain(uint8_t code, const char* text);
  size_t write_reply(uint64_t now_us);
  size_t write_edge(const Edge& edge);
  size_t write_status();
  uint8_t flags() const;

  const char* name_;
  WritePin write_pin_;

  // Shared with the interrupt.
  static constexpr uint8_t kQueue = 64;  // a power of two
  Edge queue_[kQueue];
  uint8_t head_ = 0, tail_ = 0;
  uint32_t n_overflowed_ = 0;
  Channel channels_[kChannels];
  bool is_running_ = false;
  bool is_pps_high_ = false;
  uint32_t n_pps_ = 0;
  uint64_t pps_us_ = 0;
  uint64_t next_pps_us_ = 0;
  uint64_t next_utc_s_ = 0;  // of the next pulse; 0 where not known
  int32_t slew_us_ = 0;      // still to be made up

  // The main loop's own.
  char in_[kMaxLine];
  size_t in_length_ = 0;
  bool is_in_cut_ = false;
  uint64_t in_us_ = 0;
  Reply reply_ = Reply::kHello;
  uint32_t cookie_ = 0;
  uint64_t rx_us_ = 0;
  uint8_t error_ = 0;
  const char* error_text_ = "";
  uint32_t n_lost_ = 0;
  uint32_t n_pps_told_ = 0;
  uint64_t sentence_us_ = 0;  // when the next sentence is due; 0 where none is
  uint64_t sentence_utc_s_ = 0;
  Sentence out_ = Sentence("");
  Sentence rmc_ = Sentence("");
};

// A clock of 64 bits made of one of 32 that wraps; ask it at least once per wrap.
class LongClock {
 public:
  uint64_t extend(uint32_t now) {
    if (now < last_) high_ += 1ULL << 32;
    last_ = now;
    return high_ + now;
  }

 private:
  uint64_t high_ = 0;
  uint32_t last_ = 0;
};

}  // namespace lce1

#include "board.h"

#include "gprmc.h"

namespace lce1 {

namespace {

constexpr uint64_t kUsUhz = 1000000000000ULL;  // microseconds of a period times microhertz of its rate

}  // namespace

void Board::tick(uint64_t now_us) {
  tick_pps(now_us);
  for (uint8_t i = 0; i < kChannels; ++i) tick_channel(i, now_us);
}

void Board::tick_pps(uint64_t now_us) {
  if (next_pps_us_ == 0) next_pps_us_ = now_us + kSecondUs;
  if (is_pps_high_ && now_us >= pps_us_ + kPpsHighUs) {
    is_pps_high_ = false;
    write_pin_(kPpsLine, false);
  }
  if (now_us < next_pps_us_) return;
  is_pps_high_ = true;
  write_pin_(kPpsLine, true);
  pps_us_ = now_us;
  push(EdgeKind::kPps, 0, ++n_pps_, now_us, next_utc_s_);
  if (next_utc_s_ != 0) ++next_utc_s_;
  int32_t step_us = slew_us_;
  const int32_t most_us = static_cast<int32_t>(kMaxSlewUs);
  if (step_us > most_us) step_us = most_us;
  if (step_us < -most_us) step_us = -most_us;
  slew_us_ -= step_us;
  // From when it was due, not from when it came: interrupts that are late once are not late for ever.
  next_pps_us_ += static_cast<uint64_t>(static_cast<int64_t>(kSecondUs) + step_us);
}

void Board::tick_channel(uint8_t index, uint64_t now_us) {
  Channel& channel = channels_[index];
  if (channel.is_high && now_us >= channel.fall_us) {
    channel.is_high = false;
    write_pin_(index, false);
    push(EdgeKind::kFall, index, channel.count, now_us, 0);
  }
  if (!is_running_ || channel.rate_uhz == 0) return;
  if (channel.is_waiting) {
    if (n_pps_ == 0 || pps_us_ <= channel.origin_us) return;
    channel.origin_us = pps_us_;
    channel.next_us = pps_us_ + channel.phase_us;
    channel.fraction = 0;
    const bool is_whole = channel.rate_uhz % kSecondUs == 0;
    channel.n_left = is_whole ? static_cast<uint32_t>(channel.rate_uhz / kSecondUs) : 0;
    channel.is_waiting = false;
  }
  if (channel.is_high || now_us < channel.next_us) return;
  channel.is_high = true;
  write_pin_(index, true);
  channel.fall_us = now_us + channel.pulse_us;
  push(EdgeKind::kRise, index, ++channel.count, now_us, 0);
  channel.next_us += kUsUhz / channel.rate_uhz;
  channel.fraction += kUsUhz % channel.rate_uhz;
  if (channel.fraction >= channel.rate_uhz) {
    channel.fraction -= channel.rate_uhz;
    ++channel.next_us;
  }
  // Rates in whole hertz begin anew with every second, and so follow it.
  if (channel.n_left != 0 && --channel.n_left == 0) channel.is_waiting = true;
}

// One producer, one consumer: each index is written by one of them only, after the entry it speaks of.
void Board::push(EdgeKind kind, uint8_t channel, uint32_t count, uint64_t t_us, uint64_t utc_s) {
  const uint8_t head = head_;
  const uint8_t after = static_cast<uint8_t>((head + 1) % kQueue);
  if (after == __atomic_load_n(&tail_, __ATOMIC_ACQUIRE)) {
    ++n_overflowed_;
    return;
  }
  Edge& edge = queue_[head];
  edge.kind = kind;
  edge.channel = channel;
  edge.count = count;
  edge.t_us = t_us;
  edge.utc_s = utc_s;
  __atomic_store_n(&head_, after, __ATOMIC_RELEASE);
}

bool Board::pop(Edge* edge) {
  const uint8_t tail = tail_;
  if (tail == __atomic_load_n(&head_, __ATOMIC_ACQUIRE)) return false;
  *edge = queue_[tail];
  __atomic_store_n(&tail_, static_cast<uint8_t>((tail + 1) % kQueue), __ATOMIC_RELEASE);
  return true;
}

bool Board::receive(char c, uint64_t now_us) {
  if (c != '\n') {
    if (in_length_ < kMaxLine) {
      in_[in_length_++] = c;
    } else {
      is_in_cut_ = true;
    }
    return false;
  }
  in_us_ = now_us;
  if (in_length_ > 0 && in_[in_length_ - 1] == '\r') --in_length_;
  const bool is_line = in_length_ > 0 && !is_in_cut_;
  if (!is_line) in_length_ = 0;
  is_in_cut_ = false;
  return is_line;
}

void Board::apply(uint64_t now_us) {
  const Fields fields(in_, in_length_);
  in_length_ = 0;
  uint64_t first = 0, second = 0;
  if (!fields.is_sound()) {
    complain(1, "no sentence or wrong sum");
  } else if (fields.is_name("LCEHI?") && fields.count() == 1) {
    reply_ = Reply::kHello;
  } else if (fields.is_name("LCETM?") && fields.count() == 2 && fields.whole(1, UINT32_MAX, &first)) {
    reply_ = Reply::kTime;
    cookie_ = static_cast<uint32_t>(first);
    rx_us_ = in_us_;
  } else if (fields.is_name("LCERT") && fields.count() == 5) {
    set_trigger(fields);
  } else if (fields.is_name("LCEUT") && fields.count() == 3 && fields.whole(1, kMaxUs, &first) &&
             fields.whole(2, kMaxUs / kSecondUs, &second)) {
    set_utc(first, second, now_us);
  } else if (fields.is_name("LCEGO") && fields.count() == 1) {
    if (is_running_) return;
    for (Channel& channel : channels_) {
      channel.is_waiting = true;
      channel.origin_us = pps_us_;
    }
    is_running_ = true;
  } else if (fields.is_name("LCESP") && fields.count() == 1) {
    is_running_ = false;
  } else {
    complain(2, "unknown command");
  }
}

void Board::set_trigger(const Fields& fields) {
  uint64_t index, rate_uhz, phase_us, pulse_us;
  if (!fields.whole(1, kChannels - 1, &index)) return complain(3, "no such channel");
  if (!fields.micro(2, kMaxRateUhz, &rate_uhz)) return complain(4, "rate is no number up to 1000 Hz");
  if (!fields.whole(3, kSecondUs, &phase_us) || !fields.whole(4, kSecondUs, &pulse_us)) {
    return complain(5, "phase or pulse is no number up to 1000000 us");
  }
  if (rate_uhz != 0 && (pulse_us == 0 || pulse_us * rate_uhz >= kUsUhz ||
                        phase_us * rate_uhz >= kUsUhz)) {
    return complain(6, "phase or pulse does not fit into the period");
  }
  Channel& channel = channels_[index];
  channel.rate_uhz = rate_uhz;
  channel.phase_us = static_cast<uint32_t>(phase_us);
  channel.pulse_us = static_cast<uint32_t>(pulse_us);
  channel.is_waiting = true;
  channel.origin_us = pps_us_;
}

void Board::set_utc(uint64_t t_us, uint64_t utc_s, uint64_t now_us) {
  if (next_pps_us_ == 0) return complain(7, "not started yet");
  // The beginning of a second that lies nearest to the next pulse.
  const int64_t away_us = static_cast<int64_t>(next_pps_us_) - static_cast<int64_t>(t_us);
  const int64_t half_us = kSecondUs / 2;
  const int64_t n_seconds = (away_us + (away_us >= 0 ? half_us : -half_us)) / static_cast<int64_t>(kSecondUs);
  const int64_t error_us = n_seconds * static_cast<int64_t>(kSecondUs) - away_us;
  const int64_t label_s = static_cast<int64_t>(utc_s) + n_seconds;
  if (label_s <= 0) return complain(8, "no such time");
  const int64_t most_us = kMaxSlewedUs;
  const bool is_near = -most_us <= error_us && error_us <= most_us;
  if (next_utc_s_ != 0 && static_cast<uint64_t>(label_s) == next_utc_s_ && is_near) {
    slew_us_ = static_cast<int32_t>(error_us);
    return;
  }
  next_pps_us_ = static_cast<uint64_t>(static_cast<int64_t>(next_pps_us_) + error_us);
  next_utc_s_ = static_cast<uint64_t>(label_s);
  slew_us_ = 0;
  // Neither two pulses in one, nor one in the past.
  while (next_pps_us_ < pps_us_ + kSecondUs / 2 || next_pps_us_ <= now_us) {
    next_pps_us_ += kSecondUs;
    ++next_utc_s_;
  }
}

void Board::complain(uint8_t code, const char* text) {
  reply_ = Reply::kError;
  error_ = code;
  error_text_ = text;
}

size_t Board::next_line(uint64_t now_us) {
  if (reply_ != Reply::kNone) return write_reply(now_us);
  Edge edge;
  if (pop(&edge)) return write_edge(edge);
  if (n_pps_told_ != n_pps_) {
    n_pps_told_ = n_pps_;
    return write_status();
  }
  return 0;
}

size_t Board::write_reply(uint64_t now_us) {
  const Reply reply = reply_;
  reply_ = Reply::kNone;
  if (reply == Reply::kHello) {
    out_ = Sentence("LCEHI");
    out_.number(kVersion).text(kFirmware).text(name_).number(kSecondUs);
  } else if (reply == Reply::kTime) {
    out_ = Sentence("LCETM");
    out_.number(cookie_).number(rx_us_).number(now_us);
  } else {
    out_ = Sentence("LCEER");
    out_.number(error_).text(error_text_);
  }
  return out_.finish();
}

size_t Board::write_edge(const Edge& edge) {
  if (edge.kind == EdgeKind::kPps) {
    out_ = Sentence("LCEPP");
    out_.number(edge.count).number(edge.t_us);
    if (edge.utc_s != 0) {
      out_.number(edge.utc_s);
      sentence_us_ = edge.t_us + kSentenceAfterUs;
      sentence_utc_s_ = edge.utc_s;
    } else {
      out_.empty();
    }
    out_.text("I");
  } else {
    out_ = Sentence("LCETG");
    out_.number(edge.channel).number(edge.count).number(edge.t_us);
    out_.text(edge.kind == EdgeKind::kRise ? "R" : "F");
  }
  return out_.finish();
}

size_t Board::write_status() {
  out_ = Sentence("LCEST");
  out_.number(flags()).number(n_pps_).number(n_lost_ + n_overflowed_);
  for (const Channel& channel : channels_) out_.number(channel.count);
  return out_.finish();
}

uint8_t Board::flags() const {
  return static_cast<uint8_t>((is_running_ ? 1 : 0) | 2 | (next_utc_s_ != 0 ? 4 : 0));
}

size_t Board::next_sentence(uint64_t now_us) {
  if (sentence_us_ == 0 || now_us < sentence_us_) return 0;
  sentence_us_ = 0;
  rmc_ = gprmc(sentence_utc_s_);
  return rmc_.finish();
}

}  // namespace lce1

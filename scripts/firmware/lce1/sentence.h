// NMEA-style sentences, "$" body "*" HH, built and taken apart in fixed memory.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace lce1 {

constexpr size_t kMaxLine = 120;  // longest line in either direction, with its end

// A sentence under construction. What does not fit is left out, and `finish` then gives 0.
class Sentence {
 public:
  explicit Sentence(const char* name);
  Sentence& text(const char* value);                       // a field of characters
  Sentence& number(uint64_t value, uint8_t min_digits = 1);  // a field of digits, zeros in front
  Sentence& empty();                                       // a field without content
  Sentence& digits(uint64_t value, uint8_t min_digits);    // more digits of the same field
  size_t finish();                                         // adds sum and line end; the length, or 0
  const char* data() const { return data_; }

 private:
  void put(char c);
  char data_[kMaxLine];
  size_t length_ = 0;
  bool is_full_ = false;
};

// A received line, taken apart in place. Fields are strings; the first is the name.
class Fields {
 public:
  // `line` holds `length` characters without the line end and is overwritten.
  Fields(char* line, size_t length);
  bool is_sound() const { return is_sound_; }  // framed, and its sum right
  uint8_t count() const { return count_; }
  const char* text(uint8_t index) const { return fields_[index]; }
  bool is_name(const char* name) const;
  // A whole number, and a decimal in millionths; false where there is none, or one beyond `largest` < 1e18.
  bool whole(uint8_t index, uint64_t largest, uint64_t* value) const;
  bool micro(uint8_t index, uint64_t largest, uint64_t* value) const;

 private:
  static constexpr uint8_t kMaxFields = 8;
  const char* fields_[kMaxFields];
  uint8_t count_ = 0;
  bool is_sound_ = false;
};

}  // namespace lce1

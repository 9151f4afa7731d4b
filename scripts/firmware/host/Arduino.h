// As much of the Arduino and Teensy interface as lce1.ino uses, for checking its syntax without a toolchain.
#pragma once

#include <stddef.h>
#include <stdint.h>

#define HIGH 1
#define LOW 0
#define OUTPUT 1
#define SERIAL_8N1_TXINV 0x20

uint32_t micros();
void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t value);
void digitalWriteFast(uint8_t pin, uint8_t value);
void noInterrupts();
void interrupts();

class SerialPort {
 public:
  void begin(uint32_t baud, uint32_t format = 0);
  int available();
  int availableForWrite();
  int read();
  size_t write(const char* data, size_t length);
};
extern SerialPort Serial, Serial1;

class IntervalTimer {
 public:
  bool begin(void (*function)(), float microseconds);
};

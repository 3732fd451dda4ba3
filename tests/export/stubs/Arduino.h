// What the sketch needs of Arduino's header, to compile without it.
#ifndef ARDUINO_H
#define ARDUINO_H
enum { A0 = 14 };
unsigned long micros();
int analogRead(int pin);
void analogWrite(int pin, int value);
#define constrain(x, low, high) ((x) < (low) ? (low) : ((x) > (high) ? (high) : (x)))
#endif

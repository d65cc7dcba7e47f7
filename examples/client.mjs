// A DUE app in JavaScript, from docs/wire-format.md alone: registers, beats, publishes, observes (best effort).
//   const due = new Due('unix:///path/updates.sock', 'MyNodeApp')     // or redis://127.0.0.1:6379
//   await due.init({ capabilities: [{ key: 'a.b.MyNodeApp' }] })
//   await due.observe('x.y.*', item => console.log(item.key, item.value))

import net from 'node:net'
import { randomBytes } from 'node:crypto'
const nowNs = () => BigInt(Date.now()) * 1000000n

const number = (size, type, v, write) => {
  const head = Buffer.alloc(size, type)
  head[write](v, 1)
  return head
}

export function encode(v) {                           // MessagePack, always the widest form
  if (v === null || v === undefined) return Buffer.from([0xc0])
  if (typeof v === 'boolean') return Buffer.from([v ? 0xc3 : 0xc2])
  if (typeof v === 'number' && !Number.isInteger(v)) return number(9, 0xcb, v, 'writeDoubleBE')
  if (typeof v === 'number' || typeof v === 'bigint') return v < 0
    ? number(9, 0xd3, BigInt(v), 'writeBigInt64BE') : number(9, 0xcf, BigInt(v), 'writeBigUInt64BE')
  if (typeof v === 'string') return Buffer.concat([number(5, 0xdb, Buffer.byteLength(v), 'writeUInt32BE'), Buffer.from(v)])
  if (Buffer.isBuffer(v)) return Buffer.concat([number(5, 0xc6, v.length, 'writeUInt32BE'), v])
  if (Array.isArray(v)) return Buffer.concat([number(5, 0xdd, v.length, 'writeUInt32BE'), ...v.map(encode)])
  const pairs = Object.entries(v).flatMap(([name, value]) => [encode(name), encode(value)])
  return Buffer.concat([number(5, 0xdf, pairs.length / 2, 'writeUInt32BE'), ...pairs])
}

export function decode(buffer, at = 0) {
  const take = n => buffer.subarray((at += n) - n, at)
  const uint = n => take(n).readUIntBE(0, n)
  const small = n => (Number.isSafeInteger(Number(n)) ? Number(n) : n)
  const array = n => Array.from({ length: n }, value)
  const map = n => Object.fromEntries(Array.from({ length: n }, () => [value(), value()]))
  const ext = n => ({ type: take(1).readInt8(0), data: take(n) })
  function value() {
    const t = uint(1)
    if (t < 0x80) return t
    if (t >= 0xe0) return t - 0x100
    if (t < 0x90) return map(t & 15)
    if (t < 0xa0) return array(t & 15)
    if (t < 0xc0) return take(t & 31).toString()
    const length = [0xc4, 0xc7, 0xd9].includes(t) ? 1 : [0xc5, 0xc8, 0xda, 0xdc, 0xde].includes(t) ? 2 : 4
    switch (t) {
      case 0xc0: return null
      case 0xc2: case 0xc3: return t === 0xc3
      case 0xc4: case 0xc5: case 0xc6: return take(uint(length))
      case 0xc7: case 0xc8: case 0xc9: return ext(uint(length))
      case 0xca: return take(4).readFloatBE(0)
      case 0xcb: return take(8).readDoubleBE(0)
      case 0xcc: case 0xcd: case 0xce: return uint(1 << (t - 0xcc))
      case 0xcf: return small(take(8).readBigUInt64BE(0))
      case 0xd0: case 0xd1: case 0xd2: return take(1 << (t - 0xd0)).readIntBE(0, 1 << (t - 0xd0))
      case 0xd3: return small(take(8).readBigInt64BE(0))
      case 0xd4: case 0xd5: case 0xd6: case 0xd7: case 0xd8: return ext(1 << (t - 0xd4))
      case 0xd9: case 0xda: case 0xdb: return take(uint(length)).toString()
      case 0xdc: case 0xdd: return array(uint(length))
      case 0xde: case 0xdf: return map(uint(length))
    }
    throw new Error(`MessagePack type ${t} is unknown`)
  }
  return value()
}

function connect(url, onReply) {                      // RESP2
  const path = url.match(/^(?:redis\+)?unix:\/\/(.*)/)
  const tcp = url.match(/^redis:\/\/([^:/]+):(\d+)/)
  const socket = path ? net.connect(path[1]) : net.connect(Number(tcp[2]), tcp[1])
  let rest = Buffer.alloc(0)
  const parse = at => {                               // [reply, next] or null while incomplete
    const end = rest.indexOf('\r\n', at)
    if (end < 0) return null
    const [kind, text] = [rest[at], rest.toString('latin1', at + 1, end)]
    if (kind === 36) {                                // $ bulk string
      const stop = end + 2 + Number(text)
      return Number(text) < 0 ? [null, end + 2] : rest.length < stop + 2 ? null : [rest.subarray(end + 2, stop), stop + 2]
    }
    if (kind !== 42) return [text, end + 2]           // + - :
    const replies = []
    let next = end + 2
    for (let n = Number(text), one; n > 0; n--) {
      if (!(one = parse(next))) return null
      replies.push(one[0])
      next = one[1]
    }
    return [replies, next]
  }
  socket.on('data', data => {
    rest = Buffer.concat([rest, data])
    for (let found; (found = parse(0)); rest = rest.subarray(found[1])) onReply(found[0])
  })
  const bulk = p => [Buffer.from(`$${Buffer.byteLength(p)}\r\n`), Buffer.from(p), Buffer.from('\r\n')]
  const send = (...parts) => socket.write(Buffer.concat([Buffer.from(`*${parts.length}\r\n`), ...parts.flatMap(bulk)]))
  return { send, end: () => socket.end() }
}

export class Due {
  constructor(url, app) {
    Object.assign(this, { url, app, instance: randomBytes(8).toString('hex'), counts: {}, observers: [], version: 0, epoch: 0 })
  }

  async init({ capabilities = [], interests = [], heartbeat = 0.5 } = {}) {
    this.out = connect(this.url, () => {})
    this.in = connect(this.url, reply => this.#received(reply))
    const common = { app_id: this.app, instance_id: this.instance, revision: 1 }
    const register = () => this.write(`due.registration.${this.app}`,
      { ...common, capabilities, interests, heartbeat, started: nowNs(), pid: process.pid })
    this.beat = (state = 'online') => this.write(`due.heartbeat.${this.app}`,
      { ...common, state, version: this.version, epoch: this.epoch, active: true })
    await this.observe(`due.assignment.${this.app}`, ({ value }) => {
      if (value.revisions[this.instance] !== 1) return register()
      Object.assign(this, { version: value.version, epoch: value.epoch, assignments: value.assignments })
    })
    register()
    this.timer = setInterval(() => this.beat(), heartbeat * 1000)
  }

  write(key, value) {
    const n = (this.counts[key] = (this.counts[key] ?? 0) + 1)
    const frame = [key, this.app, this.instance, this.epoch, n, n - 1, [nowNs()], null, [value]]
    this.out.send('PUBLISH', `due:${key.split(':')[0]}`, Buffer.concat([Buffer.from('DUE\x01'), encode(frame)]))
  }

  observe(key, callback) {                            // resolves when the server has confirmed it
    const path = key.split(':')[0]
    const pattern = new RegExp(`^${path.replaceAll('.', '\\.').replace(/\\\.\*\*$/, '(\\..+)?').replaceAll(/\*(?!\*)/g, '[^.]+')}$`)
    this.observers.push({ pattern, callback })
    this.in.send(path.includes('*') ? 'PSUBSCRIBE' : 'SUBSCRIBE', `due:${path.replace(/\.\*\*$/, '*')}`)
    return new Promise(resolve => (this.confirmed = resolve))
  }

  close() {
    clearInterval(this.timer)
    this.beat('offline')
    for (const connection of [this.out, this.in]) connection.end()
  }

  #received(reply) {
    if (String(reply[0]).endsWith('subscribe')) return this.confirmed()
    const payload = reply.at(-1)
    if (payload.toString('latin1', 0, 4) !== 'DUE\x01') return
    const [key, app, instance, , first, , times, events, values] = decode(payload.subarray(4))
    for (const { pattern, callback } of this.observers) {
      if (!pattern.test(key.split(':')[0])) continue
      values.forEach((value, i) => callback(
        { key, value, app, instance, sequence: first + i, timestamp: times[i], eventTime: (events ?? times)[i] }))
    }
  }
}

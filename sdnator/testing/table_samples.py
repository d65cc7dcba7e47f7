"""Small genuine tables: packet labels in three forms, tshark's, and labelled flows of three publishers."""

from sdnator.capture.tshark_tsv import COLUMNS

OWN_LABELS = "index,label,attacker\n0,0,\n1,1,AA:bb:cc:dd:ee:ff\n2,1,10.0.0.9\n3,0,\n"
LABELS = {"own": OWN_LABELS, "bare": "0\n1\n1\n0\n", "kitsune": '"","x"\n"1",0\n"2",1\n"3",1\n"4",0\n'}
"""Form to content; the labels are the same."""
TSHARK_HEADER = "\t".join(COLUMNS)
TSHARK_UDP = "1540446383.391651000\t117\t00:16:6c:7f:82:20\t4c:09:d4:c6:12:7b\t192.168.2.115\t192.168.2.1" + (
    "\t\t\t2440\t53" + "\t" * 9
)
"""A UDP packet."""
ZEEK = (
    "#separator \\x09\n#set_separator\t,\n#empty_field\t(empty)\n#unset_field\t-\n#path\tconn\n"
    "#open\t2018-12-21-15-50-38\n"
    "#fields\tts\tuid\tid.orig_h\tid.orig_p\tid.resp_h\tid.resp_p\tproto\tservice\tduration\torig_bytes\t"
    "resp_bytes\tconn_state\tlocal_orig\tlocal_resp\tmissed_bytes\thistory\torig_pkts\torig_ip_bytes\t"
    "resp_pkts\tresp_ip_bytes\ttunnel_parents   label   detailed-label\n"
    "#types\ttime\tstring\taddr\tport\taddr\tport\tenum\tstring\tinterval\tcount\tcount\tstring\tbool\tbool\t"
    "count\tstring\tcount\tcount\tcount\tcount\tset[string]   string   string\n"
    "1525879831.015811\tCUmrqr4svHuSXJy5z7\t192.168.100.103\t51524\t65.127.233.163\t23\ttcp\t-\t2.999051\t0\t0\t"
    "S0\t-\t-\t0\tS\t3\t180\t0\t0\t(empty)   Malicious   PartOfAHorizontalPortScan\n"
    "1525879832.000000\tCIgLKS3yUIg7FlMXV7\t192.168.100.1\t3\t192.168.100.103\t1\ticmp\t-\t-\t-\t-\tOTH\t-\t-\t0\t-\t1\t"
    "88\t0\t0\t-   benign   -\n"
    "#close\t2018-12-21-15-51-00\n"
)
BINETFLOW = (
    "StartTime,Dur,Proto,SrcAddr,Sport,Dir,DstAddr,Dport,State,sTos,dTos,TotPkts,TotBytes,SrcBytes,Label\n"
    "2011/08/10 09:46:53.047277,3.124000,tcp,147.32.84.165,1027,   ->,60.190.222.139,80,S_RA,0,0,4,244,124,"
    "flow=From-Botnet-V42-TCP-Attempt\n"
    "2011/08/10 09:46:54.000000,0.000000,icmp,10.0.0.1,0x0303,   ->,147.32.84.165,0x7d2b,URP,0,,1,70,70,"
    "flow=To-Botnet-V42-ICMP\n"
    "2011/08/10 09:46:55.000000,0.000000,arp,147.32.84.165,,  who,147.32.84.1,,CON,,,2,120,60,"
    "flow=From-Botnet-V42-ARP\n"
)
CIC_HEADER = (
    "Flow ID, Source IP, Source Port, Destination IP, Destination Port, Protocol, Timestamp, Flow Duration,"
    " Total Fwd Packets, Total Backward Packets, Label\n"
)
CICFLOWMETER = (
    CIC_HEADER
    + "a,172.16.0.1,52110,192.168.10.50,80,6,6/7/2017 9:20,5000000,3,1,Web Attack \x96 Brute Force\n"
    + "b,192.168.10.50,80,172.16.0.1,52112,6,7/7/2017 3:56,-1,2,0,BENIGN\n"
    + "c,192.168.10.3,53,192.168.10.5,5353,17,03/07/2017 08:55:58,1,1,1,BENIGN\n"
    + ",,,,,,,,,,\n"
)
